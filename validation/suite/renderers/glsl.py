"""GLSL's own `refract()`, by the OpenGL driver that EGL finds: Mesa's llvmpipe where there is no other."""

from .system import NOTED_F32, NOTED_F64, Call, Pip, System

SYSTEM = System(
    "glsl",
    "GLSL refract()",
    "MIT (moderngl, Mesa)",
    Pip(("moderngl==5.13.0", "numpy")),
    megabytes=100,
    small=True,
    calls=(
        Call("GLSL, vec3", "f32", "glsl_rays.py", NOTED_F32, "zero", ("float32",)),
        Call("GLSL, dvec3", "f64", "glsl_rays.py", NOTED_F64, "zero", ("float64",)),
    ),
)
