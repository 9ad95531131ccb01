"""A dispersive prism by raysect and by `refract_path`, at three lines of the spectrum.

Both render `dispersive_prism` in SF11 in the light of one of the lines C, d and F: a lamp seen through a prism, at a
different position for each line. Both compute the index themselves: raysect by the Sellmeier formula of its own library
of glasses, for rays of one narrow bin of wavelengths; `refract_path` by `int_ior` = "sellmeier(…)" in a spectral
variant, with a film that is sensitive to the same band, 1 nm wide. In both, the index varies by 1e-4 within the band,
evenly about its middle. Lamps, sky and table are grey. The images are compared by Welch's t-test of tiles and pixels.
As a control, raysect's image at one line is compared with ours at another line; this difference must be detected.
`refract_path` samples the lamps and the sky, raysect hits them by chance; see the study of images for other
differences.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import re
import tempfile
from pathlib import Path

import numpy as np

from mi_refract.image_diff.comparison import Comparison, Verdict
from mi_refract.image_diff.methods import compare
from mi_refract.io import image_file
from mi_refract.io.image_file import Image
from mi_refract.media import LINES
from mi_refract.rendering import scene_files
from mi_refract.report.row import Row
from mi_refract.scene_export import from_mitsuba, targets
from mi_refract.scene_export.plain_scene import Diffuse, Glass, Light, Mesh, PlainScene
from validation import limits
from validation.run.context import SCENES as FOLDER
from validation.run.context import Context
from validation.run.metrics import DETECTABLE, DETECTABLE_IMAGE
from validation.run.render_methods import Camera, under
from validation.study import Study, Task, about

from .rendered_images import INCONCLUSIVE, LOST, OURS, RENDERS, TERMS, Size, measured, why_not
from .renderers import SYSTEMS, environments
from .renderers.image_renderers import IMAGE_RENDERERS

NAME = "spectral lines"
OTHER, SCENE, VARIANT = "raysect", "dispersive_prism.xml", "llvm_ad_spectral"
GLASS = "SF11"  # of Schott's catalogue of 2000; INDEX: B1, B2, B3, then C1, C2, C3 in nm²
INDEX = "sellmeier(1.73848403, 0.311168974, 1.17490871, 13606.8604, 61596.0463, 121922711)"
WANTED = "C", "d", "F"
HALF, EDGE = 0.5, 0.01  # nm: half the width of the band, and the width of the edges of its response
SIZES = {"quick": Size(64, 128, 4, 0.1), "standard": Size(64, 128, 4, 0.1), "full": Size(128, 2048, 1, 0.01)}
THEIR_SPP = 1024  # divided by a size's `less`; at 768, noise hid 1 % in 6 to 9 % of the tiles, and 10 % is too much
DIMMED = 0.1  # factor of the lamps: raysect hits them by chance, so their light on the table is noise
MIXED = "lines mixed up"
NOT_SEEN, DIFFERENT = "not seen to differ", "different"
SHOWN = {name: TERMS[name] for name in ("tests that differ", "tiles that differ without noise", DETECTABLE)} | {
    DIFFERENT: "1 if tiles or pixels differ",
    NOT_SEEN: "1 if the wrong line passes",
}


def tasks(context: Context) -> list[Task]:
    """Return one task per line, and the control."""
    lines = [Task(f"{NAME}: {line}", functools.partial(line_rows, context, line)) for line in WANTED]
    return [*lines, Task(f"{NAME}: {MIXED}", functools.partial(mixed_rows, context))]


def _why_not(context: Context) -> str:
    return context.variants.get(VARIANT, "not in this wheel") or why_not(SYSTEMS["raysect"], context)


def line_rows(context: Context, line: str) -> list[Row]:
    """Return one row: equal within noise that can hide at most 1 % of the image's mean."""
    size = SIZES[context.profile.name]
    row = functools.partial(Row, NAME, OTHER, line, f"{size.resolution}²")
    reason = _why_not(context)
    images, no_answer = environments.attempt(row, reason, LOST, lambda: (ours(line, size), theirs(line, size)))
    if images is None:
        return no_answer
    comparison, values = compared(*images, size)
    values[DIFFERENT] = float(comparison.verdict is Verdict.DIFFERENT)
    budgets = {DIFFERENT: 0.0, "tests that differ": 0.0, "tiles that differ without noise": 0.0}
    budgets |= {DETECTABLE_IMAGE: float(limits.LINE_DETECTABLE)}
    goals = {INCONCLUSIVE: 0.0, DETECTABLE: size.wanted}
    replay = {"verdict": str(comparison.verdict), "nm": LINES[line], "reference spp": size.spp}
    replay |= {"spp": THEIR_SPP // size.less}
    return [row(values, budgets, goals, f"{comparison.verdict}: {comparison.reason}", replay)]


def mixed_rows(context: Context) -> list[Row]:
    """Return a row per pair of lines: raysect's image at one line against ours at another."""
    size, reason, rows = SIZES[context.profile.name], _why_not(context), list[Row]()
    for line, other in (("C", "d"), ("F", "d")):
        row = functools.partial(Row, NAME, MIXED, f"{line} for {other}", f"{size.resolution}²")

        def both(line: str = line, other: str = other) -> tuple[list[Image], list[Image]]:
            return ours(other, size), theirs(line, size)

        images, no_answer = environments.attempt(row, reason, (NOT_SEEN, 1.0), both)
        if images is None:
            rows += no_answer
            continue
        comparison, _ = compared(*images, size)
        values = {NOT_SEEN: float(comparison.verdict is not Verdict.DIFFERENT)}
        rows.append(row(values, {NOT_SEEN: 0.0}, reason=comparison.reason))
    return rows


def compared(one: list[Image], two: list[Image], size: Size) -> tuple[Comparison, dict[str, float]]:
    """Compare two sides by Welch's t-test, with single pixels (independent on both sides); return it and its values."""
    comparison = compare("welch", one, two, family_error=limits.SUITE_ERROR, resolution=size.wanted, pixels="yes")
    return comparison, measured(comparison, *(np.stack([image.pixels for image in side]) for side in (one, two)))


# The two renderers -------------------------------------------------------------------------------------------------


def plain(resolution: int) -> PlainScene:
    """Return the scene without colours, in vacuum, with dimmer lamps. Each renderer sets the prism's index itself."""

    def grey(mesh: Mesh) -> Mesh:
        match mesh.material:
            case Glass():
                return dataclasses.replace(mesh, material=dataclasses.replace(mesh.material, ext_ior=1.0))
            case Diffuse(reflectance=(_, green, _)):
                return dataclasses.replace(mesh, material=Diffuse((green,) * 3))
            case Light(radiance=(_, green, _)):
                return dataclasses.replace(mesh, material=Light((DIMMED * green,) * 3))

    text = (FOLDER / SCENE).read_text().replace('"meshes/', f'"{FOLDER}/meshes/')
    text = re.sub(r'<string name="int_ior" [^>]*/>', '<float name="int_ior" value="1.5"/>', text)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / SCENE).write_text(text)
        coloured = from_mitsuba.load(Path(folder) / SCENE, defines={"res": str(resolution)})
    assert isinstance(coloured.sky, tuple)
    return dataclasses.replace(coloured, meshes=tuple(map(grey, coloured.meshes)), sky=(coloured.sky[1],) * 3)


@functools.cache
def theirs(line: str, size: Size) -> list[Image]:
    """Return raysect's renders at a line."""

    def dispersive(folder: Path) -> None:
        document = json.loads((folder / "scene.json").read_text())
        (glass,) = [entry for entry in document["materials"].values() if entry["type"] == "glass"]
        glass["schott"] = GLASS
        (folder / "scene.json").write_text(json.dumps(document))

    band = ["--band", *(str(LINES[line] + side) for side in (-HALF, HALF))]
    with tempfile.TemporaryDirectory() as folder:
        draw, seeds = IMAGE_RENDERERS[OTHER].draw, range(1, RENDERS + 1)
        images = draw(plain(size.resolution), Path(folder), THEIR_SPP // size.less, seeds, edit=dispersive, more=band)
    return [image_file.named(image.path.name, image.pixels[..., :1]) for image in images]


@functools.cache
def ours(line: str, size: Size) -> list[Image]:
    """Return renders by `refract_path` at a line."""
    with tempfile.TemporaryDirectory() as folder, under(VARIANT):
        file = Path(folder) / "scene" / "scene.xml"
        targets.write(plain(size.resolution), "mitsuba", file.parent)
        file.write_text(spectral(file.read_text(), LINES[line]))
        camera = Camera(scene_files.load_scene(file, {"bsdf": "refract"}))
        # The film integrates over its band.
        images = [camera(size.spp, OURS + seed)[0][..., :1] / (2 * HALF + EDGE) for seed in range(RENDERS)]
    return [image_file.named(f"{line} {i}", image.astype(np.float32)) for i, image in enumerate(images)]


def spectral(text: str, wavelength: float) -> str:
    """Return the scene's XML with our integrator, the dispersive glass, grey light and a film for one band."""
    knots = zip((-HALF - EDGE, -HALF, HALF, HALF + EDGE), (0, 1, 1, 0), strict=True)
    band = ", ".join(f"{wavelength + side:.8g}:{value}" for side, value in knots)
    for pattern, replacement, times in (
        (r'<integrator type="[^"]*"', '<integrator type="refract_path"', 1),
        (r'<float name="int_ior" value="[^"]*"\s*/>', f'<string name="int_ior" value="{INDEX}"/>', 1),
        (r'<film type="hdrfilm">', f'<film type="specfilm"><spectrum name="band" value="{band}"/>', 1),
        (r'<string name="pixel_format" value="rgb"/>', "", 1),
        (r'<rgb name="(\w+)" value="([^,"]*), [^"]*"/>', r'<spectrum name="\1" value="\2"/>', 4),
    ):
        text, count = re.subn(pattern, replacement, text)
        if count != times:
            raise ValueError(f"{pattern!r} occurs {count} times; expected {times}")
    return text


STUDY = Study(NAME, "Spectral lines", about(__doc__), SHOWN, tasks)
