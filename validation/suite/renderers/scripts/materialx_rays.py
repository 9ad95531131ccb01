"""MaterialX's node `refract`, as its generator writes it in GLSL, in a compute shader of float32 through EGL."""

import re
import sys
from importlib.metadata import version

import MaterialX as mx
import moderngl
import numpy as np
import table
from MaterialX import PyMaterialXGenGlsl, PyMaterialXGenShader

SOURCE = """
#version 430
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Rays { float ray[]; };
layout(std430, binding = 1) writeonly buffer Answers { float answer[]; };
REFRACT
void main() {
    uint i = gl_GlobalInvocationID.x;
    if (3 * i >= answer.length()) return;
    vec3 a = vec3(ray[7 * i], ray[7 * i + 1], ray[7 * i + 2]);
    vec3 n = vec3(ray[7 * i + 3], ray[7 * i + 4], ray[7 * i + 5]);
    vec3 b;
    NG_refract_vector3(a, n, ray[7 * i + 6], b);
    answer[3 * i] = b.x;
    answer[3 * i + 1] = b.y;
    answer[3 * i + 2] = b.z;
}
"""


def generated():
    """The function of the node, out of the fragment shader for a graph that is this node."""
    graph, folders = mx.createDocument(), mx.getDefaultDataSearchPath()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), folders, graph)
    node = graph.addNodeInstance(graph.getNodeDef("ND_refract_vector3"), "refracted")
    output = graph.addOutput("direction", "vector3")
    output.setConnectedNode(node)
    generator = PyMaterialXGenGlsl.GlslShaderGenerator.create()
    context = PyMaterialXGenShader.GenContext(generator)
    context.registerSourceCodeSearchPath(folders)
    source = generator.generate("refraction", output, context).getSourceCode("pixel")
    return re.search(r"^void NG_refract_vector3\(.*?^\}", source, re.DOTALL | re.MULTILINE).group()


rays = table.Rays("float32")
source = SOURCE.replace("REFRACT", generated())
try:
    context = moderngl.create_context(standalone=True, backend="egl", require=430)
except Exception as error:  # of whatever kind: libraries that are missing, a driver that is too old
    print(f"no OpenGL 4.3 by EGL ({error}); Debian: libegl1 libgl1-mesa-dri", file=sys.stderr)
    sys.exit(77)
shader = context.compute_shader(source)
given = context.buffer(np.column_stack([rays.a, rays.n, rays.k]).astype(np.float32).tobytes())
answer = context.buffer(reserve=3 * len(rays) * 4)
given.bind_to_storage_buffer(0)
answer.bind_to_storage_buffer(1)
shader.run(group_x=-(-len(rays) // 64))
b = np.frombuffer(answer.read(), np.float32).reshape(-1, 3)
table.write(rays, b, f"MaterialX {version('MaterialX')}, GLSL by {context.info['GL_RENDERER']}")
