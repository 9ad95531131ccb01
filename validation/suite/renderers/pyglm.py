"""PyGLM: the mathematics library GLM, which follows GLSL, in Python."""

from .system import NOTED_F32, NOTED_F64, Call, Pip, System

SYSTEM = System(
    "pyglm",
    "PyGLM",
    "zlib",
    Pip(("PyGLM==2.8.3", "numpy")),
    megabytes=140,
    small=True,
    calls=(
        Call("PyGLM, vec3", "f32", "pyglm_rays.py", NOTED_F32, "zero", ("float32",)),
        Call("PyGLM, dvec3", "f64", "pyglm_rays.py", NOTED_F64, "zero", ("float64",)),
    ),
)
