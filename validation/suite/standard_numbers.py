"""Standard numbers by others: the same published and closed-form values, asked of every renderer that can be asked.

The numbers are those of `validation/reference/standard_numbers.py`. Prisms, drops and the double Gauss are traced
boundary by boundary: places and normals are exact, each refraction is the program's, which gets rays as for
`mi-refract rays run`; what it answers is the next ray. The critical angle is where its signal of total internal
reflection begins, on a grid of rays around it. Indices are those of its glasses by name. The transmittance of plates is
the mean of small images of a lamp behind them, by renderers of images; these do not follow polarisation, so it is the
transmittance of boundaries that pass the mean of both, which is another number but straight through. Some answer what a
boundary reflects, ray by ray. Its share of p gives Brewster's angle: the law's curve is shifted to fit best within
±REACH. Its share of unpolarised light, at the nodes of a quadrature, gives the diffuse reflectance; the phase of its
amplitudes, the retardation. Diffuse transmittances, polarised slabs and absorbing glass are asked of nobody: nothing
here answers with them.

Bounds, u = 2⁻²⁴ or 2⁻⁵³: for rays, the sum of what the roundings of the textbook formula may do to the number, 8u of
each answer and 2u of inputs and answers; for the critical angle 32u, what the program is known to give up, and a step
of the grid; for a share or a phase 10u of 1, and what 10u of the cosine and of the index do to it; for an index half a
unit of the last digit that the maker prints; for an image Student's t over eight seeds, which chance exceeds once in
ten thousand runs, and the rounding of a half float.
"""

from __future__ import annotations

import functools
import json
import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mi_refract import regimes
from mi_refract.ray_sets import header, ray_set
from mi_refract.ray_sets.files import as_csv, parse_answers
from mi_refract.ray_sets.header import PRECISIONS
from mi_refract.ray_sets.ray_set import Answers, RaySet
from mi_refract.ray_sets.renderer_file import RaysCommand
from mi_refract.report.row import Row
from mi_refract.scene_export.plain_scene import Camera, Glass, Light, Mesh, PlainScene
from validation import limits
from validation.reference import closed_forms, optical_systems
from validation.reference import standard_numbers as table
from validation.reference.optical_systems import System as Optics
from validation.reference.standard_numbers import StandardNumber
from validation.run.context import Context
from validation.run.metrics import ERROR_OVER_BOUND
from validation.study import Study, Task, about

from .rendered_images import COMPILED, PTRACER, RASTER
from .renderers import SYSTEMS, System, environments
from .renderers.glass_catalogues import CATALOGUES, GlassCatalogue
from .renderers.image_renderers import IMAGE_RENDERERS

NAME = "standard numbers by others"
MEASURED, EXACT, BOUND = "measured", "exact", "bound"
TERMS = dict(table.KINDS) | {
    EXACT: "the law in extended precision; of an index, the digits that the maker prints",
    BOUND: "of |measured − exact|",
    "unanswered": "numbers without an answer, because the program crashed, hung or answered no numbers",
}
ROUNDED = limits.TEXTBOOK_BACKWARD + 2  # u
REACH = 5.0  # degrees
CRITICAL, GRID = 32.0, 33  # u on either side of a critical angle; rays from twice as far before it to as far behind
STEP = 4 / (GRID - 1)
SEEDS, SPP, PIXELS = 8, 16, 64
FIELD = 0.2  # degrees
HALF_FLOAT = 2.0**-12  # relative
THICK, WIDE = 100.0, 3000.0  # of plates
NOT_ASKED = PTRACER, RASTER  # see no lamp through plates
DEPTH = 64
RAYS, IMAGES = ("deviation", "rainbow", "double Gauss", "critical angle"), "transmittance, unpolarised"


class Fresnel(NamedTuple):
    """Who answers what a boundary reflects: the script and its options, and the names of its answers."""

    system: str
    script: tuple[str, ...]
    precision: str
    answers: tuple[str, ...]


FRESNEL = {
    "Mitsuba, mi.fresnel_polarized": Fresnel("mitsuba", ("mitsuba_fresnel.py",), "f32", ("s", "p", "phase")),
    "optiland, JonesFresnel": Fresnel("optiland", ("optiland_fresnel.py",), "f64", ("s", "p", "phase")),
    "MaterialX, mx_fresnel_*_polarized": Fresnel("materialx", ("materialx_fresnel.py",), "f32", ("s", "p", "phase")),
    "Radiance, rtrace": Fresnel("radiance", ("radiance_rays.py", "fresnel"), "f32", ("mean",)),
}
Refract = Callable[[RaySet], Answers]
Reflect = Callable[[RaySet], dict[str, Any]]


def of_kind(*kinds: str) -> list[StandardNumber]:
    """The numbers of some kinds, in order."""
    return [number for kind in kinds for number in table.NUMBERS.values() if number.kind == kind]


def plates() -> list[StandardNumber]:
    """The numbers that renderers without polarisation can be asked."""
    straight = [x for x in of_kind("transmittance") if not (x.given["incidence"] or "absorbance" in x.given)]
    return [*straight, *of_kind(IMAGES)]


def tasks(context: Context) -> list[Task]:
    """One per function of refraction, per system with glasses, and per renderer of images."""
    rays = [
        Task(f"{NAME}: {call.title}, {call.precision}", functools.partial(ray_rows, system, call, context))
        for name, system in SYSTEMS.items()
        for call in system.calls
        if name != "mi_refract"
    ]
    glasses = [
        Task(f"{NAME}: glasses of {SYSTEMS[name].title}", functools.partial(glass_rows, SYSTEMS[name], known, context))
        for name, known in CATALOGUES.items()
    ]
    powers = [Task(f"{NAME}: {title}", functools.partial(fresnel_rows, title, context)) for title in FRESNEL]
    images = [
        Task(f"{NAME}: images of {title}", functools.partial(image_rows, title, context))
        for title in IMAGE_RENDERERS
        if title not in NOT_ASKED
    ]
    return [*rays, *glasses, *powers, *images]


def row(number: StandardNumber, subject: str, setting: str, measured: float, bound: float, remark: str) -> Row:
    """The error over its bound."""
    read = number.print_reading if number.kind == "index" else None
    exact = read[0] if read else number.value
    values = {MEASURED: float(measured), EXACT: exact, BOUND: float(bound)}
    values[ERROR_OVER_BOUND] = abs(values[MEASURED] - exact) / values[BOUND]
    return Row(NAME, subject, number.name, setting, values, {ERROR_OVER_BOUND: limits.STANDARD}, reason=remark)


# Rays ------------------------------------------------------------------------------------------------------------


def ray_rows(system: System, call: RaysCommand, context: Context) -> list[Row]:
    """A row per number of rays, or one that says why there are none."""
    made = functools.partial(Row, NAME, call.title, "every ray", call.precision)
    reason = environments.why_not(system, context.profile.name)
    versions: list[str] = []

    def refract(rays: RaySet) -> Answers:
        answers = parse_answers(environments.ask(system, call.command, as_csv(rays)), call.title)
        versions.append(str(answers.header.get("system", "")))
        return answers

    numbers = of_kind(*(kind for kind in RAYS if kind != "double Gauss" or not context.profile.quick))
    lost = ("unanswered", float(len(numbers)))
    found, nothing = environments.attempt(made, reason, lost, lambda: measure(numbers, call, refract))
    if found is None:
        return nothing
    return [row(x, call.title, call.precision, *found[x.name], versions[0]) for x in numbers]


def measure(numbers: Sequence[StandardNumber], call: RaysCommand, refract: Refract) -> dict[str, tuple[float, float]]:
    """What a function of refraction makes of numbers of RAYS, and the bound, by name."""
    systems: list[tuple[Optics, list[StandardNumber], Callable[[optical_systems.Path], Any]]] = []

    def angles(optics: Optics, angle: Callable[[Any, Any], Any]) -> Callable[[optical_systems.Path], Any]:
        return lambda path: angle(optics.directions, path.directions[-1])

    if prisms := [x for x in numbers if x.kind == "deviation"]:
        optics = table.prism(prisms)
        systems.append((optics, prisms, angles(optics, table.deviated)))
    for order in (1, 2):
        if bows := [x for x in numbers if x.kind == "rainbow" and x.given["order"] == order]:
            optics = table.drop(bows)
            systems.append((optics, bows, angles(optics, table.from_antisolar)))
    if lens := [x for x in numbers if x.kind == "double Gauss"]:
        places = [(x.given["ray"], x.given["slope"]) for x in lens]
        reading = lambda path: np.array([table.behind_the_lens(path, *at) for at in places])  # noqa: E731
        systems.append((optical_systems.double_gauss(), lens, reading))
    critical = [x for x in numbers if x.kind == "critical angle"]
    roundoff = float(np.finfo(PRECISIONS[call.precision]).eps) / 2
    found = dict[str, tuple[float, float]]()
    paths = together([optics for optics, _, _ in systems], asked(refract, call.precision))
    for (optics, mine, reading), path in zip(systems, paths, strict=True):
        bounds = ROUNDED * roundoff * conditions(optics, reading)
        found |= {x.name: (value, bound) for x, value, bound in zip(mine, reading(path), bounds, strict=True)}
    return found | critical_angles(critical, call, refract, roundoff)


def asked(refract: Refract, precision: str) -> Callable[[Any, Any, Any], Any]:
    """(a, n, k) → b of many rays at once, turned askew, rounded to the precision, with normals on the ray's side."""

    def answer(a: Any, n: Any, k: Any) -> Any:
        turn, dtype = optical_systems.ASKEW, PRECISIONS[precision]
        rays = ray_set.facing(regimes.Rays((a @ turn).astype(dtype), (n @ turn).astype(dtype), k.astype(dtype)))
        answers = refract(of_rays(rays, precision))
        b = np.full(a.shape, np.nan)
        b[answers.ids] = answers.b
        return optical_systems.unit(b.astype(np.longdouble)) @ turn.T

    return answer


def of_rays(rays: regimes.Rays, precision: str) -> RaySet:
    """A file's rays."""
    ids = np.arange(len(rays.k))
    about = {"precision": precision, "seed": 0, "regimes": {"standard numbers": [0, len(ids) - 1]}}
    return ray_set.with_checksum(RaySet(rays, ids, about))


def together(systems: Sequence[Optics], refract: Callable[[Any, Any, Any], Any]) -> list[optical_systems.Path]:
    """The paths through all systems, whose refractions of one turn are asked at once."""
    steps = [system.steps() for system in systems]
    answers: list[Any] = [None] * len(systems)
    waiting = {i: next(step) for i, step in enumerate(steps)}
    while waiting:
        parts = list(waiting.values())
        counts = np.cumsum([len(a) for a, _, _ in parts])[:-1]
        a, n = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        k = np.concatenate([np.broadcast_to(part[2], len(part[0])) for part in parts])
        for i, b in zip(list(waiting), np.split(refract(a, n, k), counts), strict=True):
            try:
                waiting[i] = steps[i].send(b)
            except StopIteration as end:
                answers[i] = end.value
                del waiting[i]
    return answers


def conditions(optics: Optics, reading: Callable[[optical_systems.Path], Any]) -> Any:
    """How many u a reading of each ray is off if a, n, k and b are off by u at each boundary, to first order."""
    exact, total = reading(optics.path()), 0.0
    for j, boundary in enumerate(optics.boundaries):
        for what in (*["into"] * (j == 0), "normal", "index", "onward") if boundary.k is not None else ():
            ways = range(1 if what == "index" else 2)
            moved = [reading(optics.path(moved=optical_systems.nudged(j, what, way))) - exact for way in ways]
            total = total + np.sqrt(sum(x**2 for x in moved)) / optical_systems.NUDGE
    return total


def critical_angles(
    numbers: Sequence[StandardNumber], call: RaysCommand, refract: Refract, roundoff: float
) -> dict[str, tuple[float, float]]:
    """The angles, in degrees, beyond which a function signals total reflection."""
    spread = {}
    for number in numbers:
        cosine = math.cos(math.radians(number.value))
        spread[number.name] = CRITICAL * roundoff + call.gives_up / (2 * number.given["n"] * cosine)
    grid = np.linspace(-2, 2, GRID)
    angles = [np.deg2rad(np.longdouble(x.value)) + spread[x.name] * grid for x in numbers]
    if not angles:
        return {}
    angle = np.concatenate(angles)
    a = optical_systems.vectors(np.sin(angle), 0, np.cos(angle))
    n = np.broadcast_to(optical_systems.vectors(0, 0, -1), a.shape)
    dtype, turn = PRECISIONS[call.precision], optical_systems.ASKEW
    k = np.repeat([x.given["n"] for x in numbers], GRID)
    rays = regimes.Rays((a @ turn).astype(dtype), (n @ turn).astype(dtype), k.astype(dtype))
    answers = refract(of_rays(rays, call.precision))
    passed = np.zeros(len(angle), bool)
    length = np.linalg.norm(answers.b, axis=1)
    through = (answers.b * -rays.n[answers.ids]).sum(1) > 0
    passed[answers.ids] = through & (length > 0.5) & (True if answers.transmitted is None else answers.transmitted)
    found = {}
    for number, signal in zip(numbers, np.split(passed, len(numbers)), strict=True):
        count = int(signal.sum())  # a mean place where the signal goes to and fro
        place = float(np.interp(count - 0.5, range(GRID), grid)) if 0 < count < GRID else math.nan
        size = math.degrees(spread[number.name])
        found[number.name] = (number.value + place * size, size * (1 + STEP))
    return found


# Fresnel's equations ---------------------------------------------------------------------------------------------


def fresnel_rows(title: str, context: Context) -> list[Row]:
    """A row per number that what a boundary reflects gives, or one that says why there are none."""
    asked = FRESNEL[title]
    system, numbers, versions = SYSTEMS[asked.system], reflected(asked.answers), list[str]()
    made = functools.partial(Row, NAME, title, "every boundary", asked.precision)

    def reflect(rays: RaySet) -> dict[str, Any]:
        data = json.loads(environments.run(environments.script(system, *asked.script), as_csv(rays)))
        try:
            versions.append(str(data["system"]))
            found = {key: np.array(data[key], float) for key in asked.answers}
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"no answer: {error!r}; expected system, {', '.join(asked.answers)} in JSON") from None
        if {x.shape for x in found.values()} != {(len(rays),)}:
            raise ValueError(f"{[x.shape for x in found.values()]} answers; expected {len(rays)} numbers of each")
        return found

    lost, reason = ("unanswered", float(len(numbers))), environments.why_not(system, context.profile.name)
    answer = functools.partial(measure_reflected, numbers, asked.precision, reflect)
    found, nothing = environments.attempt(made, reason, lost, answer)
    if found is None:
        return nothing
    return [row(x, title, asked.precision, *found[x.name], versions[0]) for x in numbers]


def reflected(known: Sequence[str]) -> list[StandardNumber]:
    """The numbers that these answers give."""
    kinds = {"p": "Brewster's angle", "phase": "retardation"}
    shares = [x for x in of_kind("diffuse") if not x.given["passed"]]
    return [*of_kind(*(kind for key, kind in kinds.items() if key in known)), *shares]


def measure_reflected(
    numbers: Sequence[StandardNumber], precision: str, reflect: Reflect
) -> dict[str, tuple[float, float]]:
    """What a program makes of numbers by what a boundary reflects, and the bound, by name."""
    dtype, roundoff = PRECISIONS[precision], float(np.finfo(PRECISIONS[precision]).eps) / 2
    cosines, reads, k = [], [], []
    for number in numbers:
        cosine, into, read = reflections(number, dtype)
        cosines.append(np.asarray(cosine, dtype).astype(np.longdouble))
        reads.append(read)
        k.append(np.full(len(cosine), 1 / into, dtype))
    cosine = np.concatenate(cosines)
    a = optical_systems.vectors(np.sqrt(1 - cosine**2), 0, -cosine).astype(dtype)
    n = np.broadcast_to(np.array([0, 0, 1], dtype), a.shape)
    answers = reflect(of_rays(regimes.Rays(a, n, np.concatenate(k)), precision))
    ends, found = np.cumsum([len(x) for x in cosines])[:-1], {}
    for i, (number, read) in enumerate(zip(numbers, reads, strict=True)):
        value, bound = read(cosines[i], {key: np.split(x, ends)[i] for key, x in answers.items()})
        found[number.name] = float(value), ROUNDED * roundoff * float(bound)
    return found


Read = Callable[[Any, dict[str, Any]], tuple[Any, Any]]


def reflections(number: StandardNumber, dtype: Any) -> tuple[Any, float, Read]:
    """Cosines of incidence, the index over that in front, and what makes the number, and its bound over ROUNDED u, of
    the cosines and the answers at them.
    """
    n = number.given["n"]
    if number.kind == "Brewster's angle":
        angles = number.value + np.linspace(-REACH, REACH, GRID)
        return np.cos(np.deg2rad(angles)), n, functools.partial(_shifted, number)
    if number.kind == "retardation":
        count, angle = number.given["reflections"], number.given["incidence"]

        def read(cosine: Any, found: dict[str, Any]) -> tuple[Any, Any]:
            slope = number.slope("n") * n + number.slope("incidence") * np.rad2deg(cosine / np.sqrt(1 - cosine**2))
            return count * np.rad2deg(np.abs(found["phase"]))[0], slope[0] + count * math.degrees(1)

        return np.cos(np.deg2rad([angle])), 1 / n, read
    outside, inside, weight = closed_forms.nodes(n, dtype)
    cosine, into, share = (outside, n, 1.0) if number.given["outside"] else (inside, 1 / n, 1 / n**2)

    def total(cosine: Any, found: dict[str, Any]) -> tuple[Any, Any]:
        """The rest, 1 − share of all light, is beyond the critical angle."""
        power = found["mean"] if "mean" in found else (found["s"] + found["p"]) / 2
        off = 1 + sum(np.abs(each).mean(0) for each in slopes(into, cosine))
        return share * (weight * power).sum() + 1 - share, share * (weight * off).sum()

    return cosine, into, total


def _shifted(number: StandardNumber, cosine: Any, found: dict[str, Any]) -> tuple[Any, Any]:
    """Brewster's angle of the curve of R_p, of first order in its shift along the law's: least squares."""
    by_cosine, by_index = (x[1] for x in slopes(number.given["n"], cosine))
    slope = by_cosine * np.deg2rad(-np.sqrt(1 - cosine**2) / cosine)  # per degree
    off, weight = share_of(number.given["n"], cosine)[1] - found["p"], slope / (slope**2).sum()
    return number.value + (off * weight).sum(), (np.abs(weight) * (1 + np.abs(by_cosine) + np.abs(by_index))).sum()


def share_of(into: Any, cosine: Any) -> np.ndarray:
    """R_s and R_p, 2 × N, of cosines of incidence."""
    return table.reflectances(into, np.rad2deg(np.arccos(cosine)))[0]


def slopes(into: float, cosine: Any) -> list[np.ndarray]:
    """∂R/∂ln of the cosine and of the index, 2 × N each, in extended precision."""
    up = 1 + np.longdouble(1e-12)
    ways = (1, up), (up, 1)
    return [(share_of(into * x, cosine * y) - share_of(into / x, cosine / y)) / (2 * (up - 1)) for x, y in ways]


# Glasses ---------------------------------------------------------------------------------------------------------


def glass_rows(system: System, catalogue: GlassCatalogue, context: Context) -> list[Row]:
    """A row per index of a glass that the system has by name."""
    made = functools.partial(Row, NAME, system.title, "every glass", "f64")
    numbers = [x for x in of_kind("index") if x.medium in catalogue.glasses]
    media, lines = list(dict.fromkeys(x.medium for x in numbers)), list(table.LINES.values())
    rays = ray_set.make(["generic"], 4 * len(media) * len(lines), "f64", 0, media=media, wavelengths=lines)

    def answer() -> Answers:
        text = environments.run(environments.script(system, catalogue.script, "glasses"), as_csv(rays))
        return parse_answers(text, system.title)

    lost, reason = ("unanswered", float(len(numbers))), environments.why_not(system, context.profile.name)
    answers, nothing = environments.attempt(made, reason, lost, answer)
    if answers is None:
        return nothing
    return [
        row(x, system.title, "f64", found, x.print_reading[1], str(answers.header.get("system", "")))
        for x, found in zip(numbers, indices(rays, answers, numbers), strict=True)
        if x.print_reading
    ]


def indices(rays: RaySet, answers: Answers, numbers: Sequence[StandardNumber]) -> list[float]:
    """The index that was used for each number; NaN where there is none."""
    ratio = np.full(len(rays), np.nan)
    if answers.n_ratio is not None:
        ratio[answers.ids] = answers.n_ratio
    wavelength, pair = header.columns(rays.header, rays.ids).T
    names = rays.header["media"]
    of_glass = np.where(ratio > 1, ratio, 1 / ratio)
    found = []
    for number in numbers:
        here = [number.medium in names[int(i)] for i in pair] & (wavelength == number.given["nm"])
        found.append(float(of_glass[here].max()) if here.any() else math.nan)
    return found


# Images ----------------------------------------------------------------------------------------------------------


def image_rows(title: str, context: Context) -> list[Row]:
    """A row per plate or pile."""
    renderer = IMAGE_RENDERERS[title]
    made, system = functools.partial(Row, NAME, title, "every plate", ""), SYSTEMS[renderer.system]
    reason = environments.why_not(system, context.profile.name) or (COMPILED if context.scalar else "")
    seeds = range(1, SEEDS + 1)

    def draw() -> list[np.ndarray]:
        found = []
        for number in plates():
            with tempfile.TemporaryDirectory() as folder:
                images = renderer.draw(plate_scene(number), Path(folder), SPP, seeds)
                found.append(np.array([image.pixels[..., 1].mean(dtype=float) for image in images]))
        return found

    found, nothing = environments.attempt(made, reason, ("unanswered", float(len(plates()))), draw)
    if found is None:
        return nothing
    rows = []
    for number, means in zip(plates(), found, strict=True):
        rows.append(row(number, title, f"{PIXELS}², {SEEDS} seeds", *of_means(means), system.source))
    return rows


def of_means(means: np.ndarray) -> tuple[float, float]:
    """The mean of images' means, and its bound."""
    from scipy import stats

    chance = stats.t.isf(limits.FALSE_ALARM / 2, len(means) - 1) * means.std(ddof=1) / math.sqrt(len(means))
    return float(means.mean()), float(chance + HALF_FLOAT * means.mean())


def plate_scene(number: StandardNumber) -> PlainScene:
    """Plates across z, a lamp of radiance 1 behind them that fills the view, and a camera that looks at an angle."""
    angle, count = math.radians(number.given["incidence"]), round(number.given.get("count", 1))
    d = np.array([math.sin(angle), 0, math.cos(angle)])
    glass = Glass(number.given["n"], 1.0)
    meshes = [box(f"plate{i}", 2 * i * THICK, glass) for i in range(count)]
    behind = 2 * count * THICK
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 4 * WIDE + [0, 0, behind]
    meshes.append(Mesh("lamp", corners.astype(float), np.array([[0, 2, 1], [0, 3, 2]]), Light((1.0, 1.0, 1.0))))
    origin = tuple((-4 * THICK * d).tolist())
    camera = Camera(origin, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), FIELD, PIXELS, PIXELS)
    return PlainScene("plates", tuple(meshes), (0.0, 0.0, 0.0), camera, DEPTH)


def box(name: str, z: float, material: Glass) -> Mesh:
    """A plate from z to z + THICK, its normals outward."""
    x, y, w = np.meshgrid([-WIDE, WIDE], [-WIDE, WIDE], [z, z + THICK], indexing="ij")
    vertices = np.stack([x, y, w], axis=-1).reshape(-1, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])
    return Mesh(name, vertices, faces, material)


STUDY = Study(NAME, "Standard numbers by others", about(__doc__), TERMS, tasks)
