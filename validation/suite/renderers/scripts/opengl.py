"""Runs a refraction function of GLSL in a compute shader, through EGL. Exits with 77 without OpenGL 4.3."""

import sys

import moderngl
import numpy as np

SOURCE = """
#version 430
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Rays { FLOAT ray[]; };
layout(std430, binding = 1) writeonly buffer Answers { FLOAT answer[]; };
FUNCTIONS
void main() {
    uint i = gl_GlobalInvocationID.x;
    if (3 * i >= answer.length()) return;
    VEC3 a = VEC3(ray[7 * i], ray[7 * i + 1], ray[7 * i + 2]);
    VEC3 n = VEC3(ray[7 * i + 3], ray[7 * i + 4], ray[7 * i + 5]);
    VEC3 b;
    CALL;
    answer[3 * i] = b.x;
    answer[3 * i + 1] = b.y;
    answer[3 * i + 2] = b.z;
}
"""


def refract(rays, precision, call, functions=""):
    """Return b (N, 3), the driver and its version.

    `call`: a GLSL statement that sets b from a, n and the ratio ray[7 * i + 6]. `functions`: GLSL that it needs.
    """
    number, vector = {"float32": ("float", "vec3"), "float64": ("double", "dvec3")}[precision]
    source = SOURCE.replace("FUNCTIONS", functions).replace("CALL", call)
    try:
        context = moderngl.create_context(standalone=True, backend="egl", require=430)
        shader = context.compute_shader(source.replace("FLOAT", number).replace("VEC3", vector))
    except Exception as error:  # any kind: missing libraries, a driver that is too old
        print(f"no {precision} in OpenGL 4.3 by EGL ({error}); Debian: libegl1 libgl1-mesa-dri", file=sys.stderr)
        sys.exit(77)
    rows = context.buffer(np.column_stack([rays.a, rays.n, rays.k]).astype(precision).tobytes())
    answer = context.buffer(reserve=3 * len(rays) * np.dtype(precision).itemsize)
    rows.bind_to_storage_buffer(0)
    answer.bind_to_storage_buffer(1)
    shader.run(group_x=-(-len(rays) // 64))
    b = np.frombuffer(answer.read(), precision).reshape(-1, 3)
    return b, context.info["GL_RENDERER"], context.info["GL_VERSION"]
