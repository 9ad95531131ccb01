"""PyGLM: the mathematics library GLM, which follows GLSL, in Python."""

from .system import RECORDED_F32, RECORDED_F64, Pip, RefractFunction, System

SYSTEM = System(
    "pyglm",
    "PyGLM",
    "zlib",
    Pip(("PyGLM==2.8.3", "numpy")),
    megabytes=140,
    small=True,
    calls=(
        RefractFunction("PyGLM, vec3", "f32", "pyglm_rays.py", RECORDED_F32, "zero", ("float32",)),
        RefractFunction("PyGLM, dvec3", "f64", "pyglm_rays.py", RECORDED_F64, "zero", ("float64",)),
    ),
)
