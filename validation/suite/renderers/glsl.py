"""GLSL's own `refract()`, by the OpenGL driver that EGL finds: Mesa's llvmpipe where there is no other."""

from .system import RECORDED_F32, RECORDED_F64, Pip, RefractFunction, System

SYSTEM = System(
    "glsl",
    "GLSL refract()",
    "MIT (moderngl, Mesa)",
    Pip(("moderngl==5.13.0", "numpy")),
    megabytes=100,
    small=True,
    calls=(
        RefractFunction("GLSL, vec3", "f32", "glsl_rays.py", RECORDED_F32, "zero", ("float32",)),
        RefractFunction("GLSL, dvec3", "f64", "glsl_rays.py", RECORDED_F64, "zero", ("float64",)),
    ),
)
