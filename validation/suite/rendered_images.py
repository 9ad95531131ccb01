"""Images: the same plain scene rendered by this plugin and by other renderers, compared by Welch's t-test.

Both sides have the same flat triangles, the same camera, a box filter, and several independent renders. The glossary
says how each renderer's model differs from Mitsuba's. `refract` is rendered with Mitsuba's `path`; Mitsuba's other
integrators, with `dielectric`, are among the other renderers. The scene `environment` has the balls of `balls` under a
smooth sky without symmetry, whose map is rotated. The scene `furnace` has a ball on a floor that absorbs nothing, under
a sky of radiance 1: nothing should be visible. The scene `caustic` shows the floor where a ball focuses a lamp; no
glass is in view, so that light tracing can render it. The verdict is "equal", "different", or "inconclusive": noise
could hide a relevant difference, or the only tiles that differ are ones about which a t-test can say little. The
profile `full` also runs the large renderers that are installed.
"""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from mi_refract.image_diff.comparison import Comparison, Verdict
from mi_refract.image_diff.methods import compare
from mi_refract.io import image_file
from mi_refract.io.errors import ExportError
from mi_refract.io.image_file import Image
from mi_refract.plugins import PLUGIN
from mi_refract.rendering import scene_files
from mi_refract.report.row import Row
from mi_refract.scene_export import from_mitsuba, targets
from mi_refract.scene_export.plain_scene import Diffuse, Environment, Glass, Light, Mesh, PlainScene
from validation import limits
from validation.run.context import SCENES as FOLDER
from validation.run.context import Context
from validation.run.metrics import DETECTABLE, DETECTABLE_IMAGE, MEAN_DIFFERENCE
from validation.run.render_methods import Camera, save_image
from validation.study import Study, Task, about
from validation.suite.renderers.image_renderers import IMAGE_RENDERERS, ImageRenderer, by_command, mean

from .renderers import SYSTEMS, System, environments

NAME = "images"
INCONCLUSIVE = "inconclusive"
TERMS = {
    "tests that differ": "tests of tiles of 16² pixels by channel, of blocks of tiles and of the whole image that find "
    "a difference; one in 10,000 pairs of equal images has any",
    "tiles that differ without noise": "among the tiles without noise on either side",
    DETECTABLE: "relative to the tile's mean, median over tiles, worst channel; for the image: relative to its mean",
    INCONCLUSIVE: "1 if no difference was found, but noise could hide a relevant one",
    MEAN_DIFFERENCE: "mean of the other renderer's image over that of the reference − 1",
    "RMSE / noise": "RMSE of the two means over what the spread between renders predicts: 1 for equal images, unless a "
    "renderer samples a fixed grid, whose error is not in that spread",
    "reference, test, difference": f"`{PLUGIN}`, the other renderer, test − reference: means over the renders",
} | {f"{title}, assumed": " ".join(renderer.assumed) for title, renderer in IMAGE_RENDERERS.items()}
RENDERS = 4  # per side
OURS = 1000  # the first seed of the reference
LEVEL = 4  # of the spheres' subdivision: facets are visible, so both sides must shade them flat
LOST = "not rendered", float(RENDERS)
COMPILED = "needs a compiled variant: it takes millions of samples"


@dataclasses.dataclass(frozen=True)
class Size:
    """`spp` of each reference render; other renderers' spp are divided by `less`; `wanted`: detectable difference."""

    resolution: int
    spp: int
    less: int
    wanted: float


SIZES = {"quick": Size(64, 64, 32, 0.1), "standard": Size(64, 64, 32, 0.1), "full": Size(128, 2048, 1, 0.01)}


@dataclasses.dataclass(frozen=True)
class Scene:
    """`known`: renderers known to differ, which the study must detect. `more`: factor of the reference's spp."""

    load: Callable[[int], PlainScene]
    known: tuple[str, ...] = ()
    more: int = 1


def _scene(name: str, resolution: int) -> PlainScene:
    return from_mitsuba.load(FOLDER / f"{name}.xml", level=LEVEL, defines={"res": str(resolution)})


def environment(resolution: int) -> PlainScene:
    """Return the balls under the rotated sky."""
    return dataclasses.replace(_scene("balls", resolution), name="environment", sky=askew())


def furnace(resolution: int) -> PlainScene:
    """Return the ball on a white floor that absorbs nothing, in a white sky: a correct image is 1 everywhere."""
    plain, white = _scene("sphere", resolution), (1.0, 1.0, 1.0)

    def bright(mesh: Mesh) -> Mesh:
        return dataclasses.replace(mesh, material=Diffuse(white)) if isinstance(mesh.material, Diffuse) else mesh

    meshes = tuple(bright(mesh) for mesh in plain.meshes if not isinstance(mesh.material, Light))
    return dataclasses.replace(plain, name="furnace", meshes=meshes, sky=white)


def caustic(resolution: int) -> PlainScene:
    """Return the floor beside the ball's shadow, where its lamp is focused: no glass in view, and a black sky."""
    plain = _scene("sphere", resolution)

    def lifted(mesh: Mesh) -> Mesh:
        if not isinstance(mesh.material, Glass):
            return mesh
        return dataclasses.replace(mesh, vertices=mesh.vertices + np.array([0, 30, 0]))

    origin, target = (140.0, 60.0, 40.0), (42.0, 0.0, 9.0)
    camera = dataclasses.replace(plain.camera, origin=origin, target=target, fov_x_degrees=20.0)
    meshes = tuple(map(lifted, plain.meshes))
    return dataclasses.replace(plain, name="caustic", meshes=meshes, sky=(0.0, 0.0, 0.0), camera=camera)


def askew() -> Environment:
    """Return a smooth sky without symmetry, rotated about two axes."""
    height, width = 64, 128
    theta, phi = np.pi * np.arange(height) / (height - 1), 2 * np.pi * (np.arange(width) + 0.5) / width
    t, p = np.meshgrid(theta, phi, indexing="ij")
    x, y, z = np.sin(p) * np.sin(t), np.cos(t), -np.cos(p) * np.sin(t)
    pixels = np.stack([0.9 + 0.5 * x + 0.3 * y * z, 0.8 + 0.4 * y + 0.3 * x * z, 0.7 - 0.4 * z + 0.3 * y * y * x], -1)
    about_y, about_x = 0.7, 0.4
    cos, sin = np.cos, np.sin
    first = [[cos(about_y), 0, sin(about_y)], [0, 1, 0], [-sin(about_y), 0, cos(about_y)]]
    second = [[1, 0, 0], [0, cos(about_x), -sin(about_x)], [0, sin(about_x), cos(about_x)]]
    return Environment(pixels.astype(np.float32), np.array(first) @ np.array(second))


THREE, RASTER, PTRACER = "three-gpu-pathtracer", "three, MeshPhysicalMaterial", "Mitsuba, ptracer"
SCENES = {
    "sphere": Scene(functools.partial(_scene, "sphere"), (PTRACER,)),
    "prism": Scene(functools.partial(_scene, "prism"), (THREE, RASTER)),
    "environment": Scene(environment),
    "furnace": Scene(furnace, (THREE,)),
    "caustic": Scene(caustic, more=4),
}
# Why a renderer is known to differ.
WHY = {
    THREE: "its shadow rays to the sky pass straight through glass, and its refracted rays find the same sky, so this "
    "light counts twice; see the row without multiple importance sampling (MIS)",
    RASTER: "emitting surfaces light nothing, the sky casts no shadows, and a ray is refracted only once: it shows the "
    "image without glass at the distance thicknessFactor behind the first surface",
    PTRACER: "a path from a lamp cannot be joined with the camera through smooth glass, so the ball is black",
}


def join(system: System) -> None:
    """Put a system with a command for images in front of the others. ValueError for an unknown export or scene."""
    images, where = system.images, f"{system.folder}: images."
    if images is None:
        return
    if images.export not in targets.TARGETS:
        raise ValueError(f"{where}export: {images.export!r}; expected {', '.join(targets.TARGETS)}")
    for scene in (*images.spp, *images.deviations):
        if scene not in SCENES:
            raise ValueError(f"{where}spp, images.deviation: {scene!r}; expected {', '.join(SCENES)}")
    if system.title in IMAGE_RENDERERS:
        raise ValueError(
            f"{system.folder}: title: {system.title!r} is the title of another renderer; expected a unique title"
        )
    assumed, draw = images.assumed or ("not stated.",), functools.partial(by_command, system)
    others = dict(IMAGE_RENDERERS)
    IMAGE_RENDERERS.clear()
    IMAGE_RENDERERS.update({system.title: ImageRenderer(system.name, draw, images.spp, assumed)} | others)
    TERMS[f"{system.title}, assumed"] = " ".join(assumed)


def known_to_differ(title: str, scene: str) -> str:
    """Return why a renderer is known to differ on a scene; "" if it is not."""
    if title in SCENES[scene].known:
        return WHY[title]
    images = SYSTEMS[IMAGE_RENDERERS[title].system].images
    return images.deviations.get(scene, "") if images else ""


def tasks(context: Context) -> list[Task]:
    """Return one task per renderer and scene."""
    return [
        Task(f"images: {title}, {scene}", functools.partial(pair_rows, context, title, scene))
        for title, renderer in IMAGE_RENDERERS.items()
        for scene in renderer.spp
    ]


def why_not(system: System, context: Context) -> str:
    """Return why the images of a renderer are not compared in this run; "" if they are."""
    return environments.why_not(system, context.profile.name) or (COMPILED if context.scalar else "")


def pair_rows(context: Context, title: str, scene: str) -> list[Row]:
    """Return one row: a renderer against `refract` in a scene."""
    renderer, size = IMAGE_RENDERERS[title], SIZES[context.profile.name]
    row = functools.partial(Row, NAME, title, scene, f"{size.resolution}²")
    seeds, spp = range(1, RENDERS + 1), max(renderer.spp[scene] // size.less, 1)

    def draw() -> list[Image]:
        with tempfile.TemporaryDirectory() as folder:
            try:
                return renderer.draw(SCENES[scene].load(size.resolution), Path(folder), spp, seeds)
            except ExportError as error:
                raise environments.Unable(str(error)) from None

    theirs, no_answer = environments.attempt(row, why_not(SYSTEMS[renderer.system], context), LOST, draw)
    if theirs is None:
        return no_answer
    ours, known = reference(scene, size), known_to_differ(title, scene)
    # Single pixels are not tested: some renderers sample every pixel on one grid, whatever the seed.
    comparison = compare("welch", ours, theirs, family_error=limits.SUITE_ERROR, resolution=size.wanted, pixels="no")
    values = measured(comparison, *(np.stack([image.pixels for image in side]) for side in (ours, theirs)))
    goals, budgets = {INCONCLUSIVE: 0.0}, {"tests that differ": 0.0, "tiles that differ without noise": 0.0}
    reason = f"{comparison.verdict}: {comparison.reason}"
    if known:
        values["not seen to differ"] = float(comparison.verdict is not Verdict.DIFFERENT)
        budgets = {"not seen to differ": 0.0}
        reason += f"; {known}" if comparison.verdict is Verdict.DIFFERENT else ""
    else:
        goals[DETECTABLE] = size.wanted
    replay = {"verdict": str(comparison.verdict), "scene": scene, "resolution": size.resolution, "spp": spp}
    replay |= {"reference spp": SCENES[scene].more * size.spp, "seeds": list(seeds)}
    replay["renderer"] = SYSTEMS[renderer.system].source
    return [row(values, budgets, goals, reason, replay, _saved(context, title, scene, ours, theirs))]


@functools.cache
def reference(scene: str, size: Size) -> list[Image]:
    """Return images by this plugin in the current variant."""
    renders = by_plugin(SCENES[scene].load(size.resolution), SCENES[scene].more * size.spp)
    return [image_file.named(f"{PLUGIN} {scene} {i}", pixels) for i, pixels in enumerate(renders)]


def by_plugin(plain: PlainScene, spp: int) -> list[np.ndarray]:
    """Return RENDERS images, height × width × 3, by this plugin of a scene's export for Mitsuba."""
    with tempfile.TemporaryDirectory() as folder:
        targets.write(plain, "mitsuba", Path(folder) / "scene")
        camera = Camera(scene_files.load_scene(Path(folder) / "scene" / "scene.xml", {"bsdf": PLUGIN}))
        return [mean(camera, spp, OURS + i) for i in range(RENDERS)]


def measured(comparison: Comparison, ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """Return the values of a row; `ours` and `theirs` are renders × height × width × 3."""
    metrics = {metric.name: metric.value for metric in comparison.metrics}
    noise = sum(side.var(0, ddof=1).mean() / len(side) for side in (ours.astype(float), theirs.astype(float)))
    rmse = np.sqrt(np.square(theirs.mean(0) - ours.mean(0)).mean())
    values = {
        "tests that differ": metrics.get("tests of tiles and channels that differ", np.nan),
        "tiles that differ without noise": metrics.get("tiles without noise that differ", np.nan),
        DETECTABLE: comparison.minimum_detectable,
        DETECTABLE_IMAGE: metrics.get("minimum detectable difference of the whole image", np.nan),
        INCONCLUSIVE: float(comparison.verdict is Verdict.INCONCLUSIVE),
        MEAN_DIFFERENCE: float(theirs.mean() / ours.mean() - 1),
    }
    return values | ({"RMSE / noise": float(rmse / np.sqrt(noise))} if noise > 0 else {})


def _saved(context: Context, title: str, scene: str, ours: Sequence[Image], theirs: Sequence[Image]) -> dict[str, str]:
    """Write both means and their difference as EXR files below the output folder; return their paths by role."""
    reference_mean, test_mean = (
        np.stack([image.pixels for image in side]).mean(0, dtype=np.float64) for side in (ours, theirs)
    )
    images = {
        "reference": (PLUGIN, reference_mean),
        "test": (title, test_mean),
        "difference": (f"{title} difference", test_mean - reference_mean),
    }
    return {role: save_image(context.out, f"{NAME}/{scene}/{name}", x, {}) for role, (name, x) in images.items()}


STUDY = Study(NAME, "Images", about(__doc__), TERMS, tasks)
