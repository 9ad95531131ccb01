"""The table of other renderers and libraries: how to install each, what it can do, and how it behaved.

A new renderer is one entry here. A function of refraction also needs a script in scripts/, an image renderer an entry
in `image_renderers`. Programs under the GPL are run, never imported nor redistributed.
"""

from .system import RECORDED_F32, RECORDED_F64, Apt, Npm, Pip, RefractFunction, System, recorded_error


def _as_in_glsl(title: str, script: str) -> tuple[RefractFunction, ...]:
    """`refract` of vec3 and of dvec3, which answer total internal reflection with the null vector."""
    return (
        RefractFunction(f"{title}, vec3", "f32", script, RECORDED_F32, "zero", ("float32",)),
        RefractFunction(f"{title}, dvec3", "f64", script, RECORDED_F64, "zero", ("float64",)),
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
