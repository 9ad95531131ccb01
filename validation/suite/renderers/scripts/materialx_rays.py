"""MaterialX's node `refract`, in the GLSL of its generator, in a compute shader of float32 through EGL."""

import re
from importlib.metadata import version

import MaterialX as mx
import opengl
import table
from MaterialX import PyMaterialXGenGlsl, PyMaterialXGenShader


def generated():
    """Return the node's function from the fragment shader that is generated for a graph of this node."""
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
call = "NG_refract_vector3(a, n, ray[7 * i + 6], b)"
b, renderer, _ = opengl.refract(rays, "float32", call, generated())
table.write(rays, b, f"MaterialX {version('MaterialX')}, GLSL by {renderer}")
