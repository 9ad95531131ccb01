"""The table of other renderers and libraries: how to install each, what it can do, and how it behaved.

A new renderer is one entry here. A function of refraction also needs a script in scripts/, an image renderer an entry
in `image_renderers`. Programs under the GPL are run, never imported nor redistributed.
"""

from .system import (
    RECORDED_F32,
    RECORDED_F64,
    Apt,
    Npm,
    Pip,
    RecordedError,
    RefractFunction,
    System,
    recorded_error,
)


def _as_in_glsl(title: str, script: str) -> tuple[RefractFunction, ...]:
    """`refract` of vec3 and of dvec3, which answer total internal reflection with the null vector."""
    return (
        RefractFunction(f"{title}, vec3", "f32", script, RECORDED_F32, "zero", ("float32",), lengths="used"),
        RefractFunction(f"{title}, dvec3", "f64", script, RECORDED_F64, "zero", ("float64",), lengths="used"),
    )


# GLSL's formula as compilers for processors order it, from scalar code and from code for vectors. These figures, and
# those given in numbers to `_in_both`, batoid, pyoptools and prysm, were recorded on the sets at their default seed.
_RECORDED_SCALAR_F32 = recorded_error((2.0e-6, 4.9e-6), 5.5e-4, 1.2e-7, 3.0e-7)
_RECORDED_SCALAR_F64 = recorded_error((2.1e-15, 8.6e-15), 9.3e-13, 1.7e-16, 6.4e-16)
_RECORDED_VECTOR_F32 = recorded_error((2.0e-6, 3.9e-6), 5.5e-4, 1.2e-7, 3.0e-7)


def _in_both(title: str, script: str, f32: RecordedError, f64: RecordedError) -> tuple[RefractFunction, ...]:
    """A `refract` of float32 and of float64, as GLSL describes it."""
    return (
        RefractFunction(f"{title}, refract", "f32", script, f32, "zero", ("float32",), lengths="used"),
        RefractFunction(f"{title}, refract", "f64", script, f64, "zero", ("float64",), lengths="used"),
    )


_SYSTEMS = (
    System(
        "mitsuba",
        "Mitsuba",
        "BSD-3-Clause",
        None,
        megabytes=0,
        small=True,
        draws=True,
        calls=(
            RefractFunction(
                "Mitsuba, mi.fresnel + mi.refract",
                "f32",
                "mitsuba_rays.py",
                recorded_error(1.4e-6, 4.3e-4, 2e-7, 1.2e-6),
                "flag",
                ("functions",),
            ),
            # Of the functions: `dielectric` has the rounding of its frame, too. It misses the goal on random rays.
            RefractFunction(
                "Mitsuba, dielectric",
                "f32",
                "mitsuba_rays.py",
                recorded_error(1.4e-6, 4.3e-4, 2e-7, 1.2e-6),
                "flag",
                ("dielectric",),
            ),
        ),
    ),
    System(  # the mathematics library GLM, which follows GLSL
        "pyglm",
        "PyGLM",
        "zlib",
        Pip(("PyGLM==2.8.3", "numpy")),
        megabytes=140,
        small=True,
        calls=_as_in_glsl("PyGLM", "pyglm_rays.py"),
    ),
    System(  # by the OpenGL driver that EGL finds: Mesa's llvmpipe where there is no other
        "glsl",
        "GLSL refract()",
        "MIT (moderngl, Mesa)",
        Pip(("moderngl==5.13.0", "numpy")),
        megabytes=100,
        small=True,
        calls=_as_in_glsl("GLSL", "glsl_rays.py"),
    ),
    System(  # a ray tracer for lens design, with its glasses; the trace needs none of its windows and plots
        "rayoptics",
        "rayoptics",
        "BSD-3-Clause (rayoptics, opticalglass)",
        Pip(("rayoptics==0.9.8", "opticalglass==1.1.1", "numpy")),
        megabytes=260,
        small=True,
        lens="rayoptics_lens.py",
        calls=(
            RefractFunction(
                "rayoptics, bend", "f64", "rayoptics_rays.py", recorded_error(7e-15, 1.9e-12, 2e-16, 1e-15), "nan"
            ),
        ),
    ),
    System(
        "optiland",
        "optiland",
        "MIT",
        Pip(("optiland==0.6.3",)),
        megabytes=1300,
        lens="optiland_lens.py",
        calls=(
            RefractFunction(
                "optiland, RealRays.refract",
                "f64",
                "optiland_rays.py",
                recorded_error(9e-15, 1.9e-12, 3e-16, 1e-15),
                "nan",
            ),
        ),
    ),
    System(  # a spectral ray tracer in Python and Cython, for plasma diagnostics; its cameras want matplotlib
        "raysect",
        "raysect",
        "BSD-3-Clause",
        Pip(("raysect==0.9.0", "numpy")),
        megabytes=190,
        small=True,
        draws=True,
        calls=(
            RefractFunction(
                "raysect, Dielectric",
                "f64",
                "raysect_rays.py",
                recorded_error((5.1e-15, 2.5e-14), (1.6e-12, 2.5e-12), (2.3e-16, 2.9e-16), (5.4e-16, 6.5e-16)),
                "reflected",
                remark="normalises the ray and the normal; takes a ray at the critical angle for total reflection",
            ),
        ),
    ),
    System(  # of WebGPU, whose implementation in Rust hands it to Vulkan: Mesa's llvmpipe where there is no GPU
        "wgsl",
        "WGSL refract()",
        "BSD-2-Clause (wgpu), MIT or Apache-2.0 (wgpu-native), MIT (Mesa)",
        Pip(("wgpu==0.32.0", "numpy")),
        megabytes=70,
        small=True,
        calls=_in_both(
            "WGSL",
            "wgsl_rays.py",
            recorded_error((1.6e-6, 5.7e-6), 5.5e-4, 1.2e-7, 3.2e-7),
            recorded_error((2.2e-15, 8.4e-15), 8.7e-13, 1.8e-16, 4.8e-16),
        ),
    ),
    System(  # compiled by g++, without which it cannot run
        "slang",
        "Slang refract()",
        "Apache-2.0 WITH LLVM-exception (Slang, slangpy)",
        Pip(("slangpy==0.43.1", "numpy")),
        megabytes=340,
        calls=_in_both("Slang", "slang_rays.py", _RECORDED_SCALAR_F32, _RECORDED_SCALAR_F64),
    ),
    System(  # the node of a graph, through the GLSL that the generator writes
        "materialx",
        "MaterialX refract node",
        "Apache-2.0 (MaterialX), MIT (moderngl, Mesa)",
        Pip(("MaterialX==1.39.5", "moderngl==5.13.0", "numpy")),
        megabytes=90,
        small=True,
        calls=(
            RefractFunction(
                "MaterialX, refract node",
                "f32",
                "materialx_rays.py",
                _RECORDED_VECTOR_F32,
                "zero",
                lengths="used",
            ),
        ),
    ),
    System(  # the shading language of the graphics library of Chrome, Android and Flutter, on the processor
        "skia",
        "Skia SkSL refract()",
        "BSD-3-Clause",
        Pip(("skia-python==144.1", "numpy")),
        megabytes=110,
        small=True,
        calls=(RefractFunction("Skia, SkSL", "f32", "skia_rays.py", _RECORDED_VECTOR_F32, "zero", lengths="used"),),
    ),
    System(
        "taichi",
        "Taichi",
        "Apache-2.0",
        Pip(("taichi==1.7.4", "numpy")),
        megabytes=230,
        calls=_in_both("Taichi", "taichi_rays.py", _RECORDED_SCALAR_F32, _RECORDED_SCALAR_F64),
    ),
    System(
        "raylib",
        "raylib",
        "Zlib (raylib), EPL-2.0 (its bindings)",
        Pip(("raylib==6.2.0.0", "numpy")),
        megabytes=66,
        small=True,
        calls=(
            RefractFunction(
                "raylib, Vector3Refract", "f32", "raylib_rays.py", _RECORDED_SCALAR_F32, "zero", lengths="used"
            ),
        ),
    ),
    System(  # in JavaScript
        "thi_ng",
        "@thi.ng/vectors",
        "Apache-2.0",
        Npm(("@thi.ng/vectors@8.7.0",)),
        megabytes=5,
        small=True,
        calls=(
            RefractFunction(
                "@thi.ng/vectors, refract3", "f64", "thi_ng_rays.mjs", _RECORDED_SCALAR_F64, "zero", lengths="used"
            ),
        ),
    ),
    System(  # a ray tracer for telescopes
        "batoid",
        "batoid",
        "BSD-2-Clause",
        Pip(("batoid==0.9.0", "numpy")),
        megabytes=570,
        calls=(
            RefractFunction(
                "batoid, Plane.refract",
                "f64",
                "batoid_rays.py",
                recorded_error((5.4e-15, 8.6e-15), 1.2e-12, 3.9e-16, 2.5e-15),
                "nan",
                lengths="speed",
                remark="asked through a frame in which the normal is (0, 0, 1), whose rounding counts",
            ),
        ),
    ),
    System(  # a ray tracer for optical laboratories
        "pyoptools",
        "pyoptools",
        "GPL-3.0-or-later",
        Pip(("pyoptools==0.4.1",)),
        megabytes=430,
        calls=(
            RefractFunction(
                "pyoptools, Plane.propagate",
                "f64",
                "pyoptools_rays.py",
                recorded_error((4.5e-15, 6.5e-15), 1.3e-12, 3.0e-16, 5.8e-16),
                "reflected",
                lengths="ray scaled",
                remark="asked through a frame in which the normal is (0, 0, 1), whose rounding counts",
            ),
        ),
    ),
    System(  # physical optics with an experimental ray tracer; its release is source only
        "prysm",
        "prysm",
        "MIT",
        Pip(("prysm==0.21.1", "numpy", "scipy", "setuptools==69.5.1", "setuptools-scm", "wheel"), built="prysm"),
        megabytes=180,
        small=True,
        calls=(
            RefractFunction(
                "prysm, Spencer and Murty",
                "f64",
                "prysm_rays.py",
                recorded_error((2.2e-15, 8.4e-15), 1.1e-12, 2.0e-16, 6.2e-16),
                "nan",
                lengths="used",
                remark="takes a normal on the far side only",
            ),
        ),
    ),
    System(  # by the programs in pyradiance's wheel
        "radiance",
        "Radiance",
        "BSD (pyradiance), Radiance Software License",
        Pip(("pyradiance==1.3.1", "numpy")),
        megabytes=120,
        small=True,
        draws=True,
        calls=(
            RefractFunction(
                "Radiance, rtrace",
                "f64",
                "radiance_rays.py",
                recorded_error(5e-15, 4e-13, 1e-16, 3e-16),
                "reflected",
                gives_up=1e-6,
                remark="takes cos²θ_t below 1e-6 for total reflection, and misses a surface met at less than 1e-6 rad",
            ),
        ),
    ),
    System(  # Blender's, by its Python module, whose wheels are for Python 3.11
        "cycles",
        "Cycles",
        "GPL-3.0-or-later (Blender); Cycles itself Apache-2.0",
        Pip(("bpy==5.0.1", "numpy<2"), python="3.11"),
        megabytes=970,
        draws=True,
        calls=(RefractFunction("Cycles, refraction closure", "f32", "cycles_rays.py", RECORDED_F32, "zero"),),
    ),
    System("luxcore", "LuxCore", "Apache-2.0", Pip(("pyluxcore==2.11.2", "numpy")), megabytes=390, draws=True),
    System(
        "povray",
        "POV-Ray",
        "AGPL-3.0-or-later",
        Apt("povray", ("povray=1:3.7.0.10-*",), "3.7.0.10"),
        megabytes=60,
        draws=True,
    ),
    System(  # in a headless Chromium, whose WebGL2 runs on the processor
        "three",
        "three-gpu-pathtracer",
        "MIT (three, three-gpu-pathtracer, three-mesh-bvh), Apache-2.0 (puppeteer-core)",
        Npm(("three@0.187.0", "three-gpu-pathtracer@0.0.26", "three-mesh-bvh@0.9.17", "puppeteer-core@24.43.1")),
        megabytes=90,
        draws=True,
    ),
)
SYSTEMS: dict[str, System] = {system.name: system for system in _SYSTEMS}
