"""Standard numbers by others: published and closed-form values, measured with other renderers.

The numbers are those of `validation/reference/standard_numbers.py`; each program measures those that it can. Prisms,
drops and the double Gauss are traced boundary by boundary: points and normals are exact, the program refracts each ray,
as for `mi-refract rays run`, and its answer is the next ray. The critical angle is where the program starts to signal
total internal reflection, on a grid of rays around it. Indices are those of the program's glasses, looked up by name.
The transmittance of plates is the mean of small images of a lamp behind them. These renderers do not follow
polarisation, so each boundary transmits the mean of both polarisations: a different number, except at normal incidence.
Some programs return what a boundary reflects, ray by ray. The reflectance of p gives Brewster's angle: the exact curve
is shifted to fit best within ±5 degrees. The unpolarised reflectance, at the nodes of a quadrature, gives the diffuse
reflectance; the phase of the amplitudes gives the retardation. No program here measures diffuse transmittances,
polarised slabs or absorbing glass.

Bounds, with u = 2⁻²⁴ or 2⁻⁵³: for rays, the sum of the effects of all boundaries, where each answer is exact for inputs
perturbed by 8u (the textbook formula), and inputs and answers are rounded, 2u. For the critical angle, 32u, the range
that the program is known to give up, and a step of the grid. For a reflectance or a phase, 10u of 1 and the effects of
10u of the cosine and of the index. For an index, half a unit of the maker's last printed digit. For an image, Student's
t over eight seeds, which chance exceeds once in ten thousand runs, and the rounding of a half float.
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
from mi_refract.ray_sets.tir_signal import ALONG
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
    EXACT: "the value of the law in extended precision; for an index, the maker's printed digits",
    BOUND: "of |measured − exact|",
    "unanswered": "numbers without an answer, because the program crashed, hung or returned no numbers",
}
ROUNDED = limits.TEXTBOOK_BACKWARD + 2  # u
REACH = 5.0  # degrees
CRITICAL, GRID = 32.0, 33  # spread around a critical angle, in u; number of rays from −2 to 2 spreads
STEP = 4 / (GRID - 1)  # of the grid, in spreads
SEEDS, SPP, PIXELS = 8, 16, 64
FIELD = 0.2  # of the camera, in degrees
HALF_FLOAT = 2.0**-12  # relative rounding error
THICK, WIDE = 100.0, 3000.0  # thickness and half width of plates
NOT_ASKED = PTRACER, RASTER  # they cannot show a lamp through plates
DEPTH = 64
RAYS, IMAGES = ("deviation", "rainbow", "double Gauss", "critical angle"), "transmittance, unpolarised"


class Fresnel(NamedTuple):
    """A system that returns what a boundary reflects: the script with its options, and the names of its answers."""

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
    """Return the numbers of some kinds, in the order of the kinds."""
    return [number for kind in kinds for number in table.NUMBERS.values() if number.kind == kind]


def plates() -> list[StandardNumber]:
    """Return the transmittances of plates that renderers without polarisation can measure."""
    straight = [x for x in of_kind("transmittance") if not (x.given["incidence"] or "absorbance" in x.given)]
    return [*straight, *of_kind(IMAGES)]


def tasks(context: Context) -> list[Task]:
    """Return one task per function of refraction, system with glasses, Fresnel function and renderer of images."""
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
    """Return the row of a measured number: its error over its bound."""
    printed = number.print_reading if number.kind == "index" else None
    exact = printed[0] if printed else number.value
    values = {MEASURED: float(measured), EXACT: exact, BOUND: float(bound)}
    with np.errstate(divide="ignore", invalid="ignore"):  # black images have a bound of 0
        values[ERROR_OVER_BOUND] = float(np.divide(abs(values[MEASURED] - exact), values[BOUND]))
    return Row(NAME, subject, number.name, setting, values, {ERROR_OVER_BOUND: limits.STANDARD}, reason=remark)


# Rays ------------------------------------------------------------------------------------------------------------


def ray_rows(system: System, call: RaysCommand, context: Context) -> list[Row]:
    """Return a row per number that rays give, or one row with the reason why there are none."""
    no_row = functools.partial(Row, NAME, call.title, "every ray", call.precision)
    reason = environments.why_not(system, context.profile.name)
    versions: list[str] = []

    def refract(rays: RaySet) -> Answers:
        answers = _known(parse_answers(environments.ask(system, call.command, as_csv(rays)), call.title), rays)
        versions.append(str(answers.header.get("system", "")))
        return answers

    numbers = of_kind(*(kind for kind in RAYS if kind != "double Gauss" or not context.profile.quick))
    lost = ("unanswered", float(len(numbers)))
    measured, no_answer = environments.attempt(no_row, reason, lost, lambda: measure(numbers, call, refract))
    if measured is None:
        return no_answer
    return [row(x, call.title, call.precision, *measured[x.name], versions[0]) for x in numbers]


def _known(answers: Answers, rays: RaySet) -> Answers:
    """Return the answers. ValueError if one is to no ray of the set."""
    if (unknown := answers.ids[~np.isin(answers.ids, rays.ids)]).size:
        raise ValueError(f"an answer to the ray {unknown[0]}; expected rays from {rays.ids[0]} to {rays.ids[-1]}")
    return answers


def measure(numbers: Sequence[StandardNumber], call: RaysCommand, refract: Refract) -> dict[str, tuple[float, float]]:
    """Return measured value and bound, by name, of numbers of RAYS with a function of refraction."""
    systems: list[tuple[Optics, list[StandardNumber], Callable[[optical_systems.Path], Any]]] = []

    def angles(optics: Optics, angle: Callable[[Any, Any], Any]) -> Callable[[optical_systems.Path], Any]:
        return lambda path: angle(optics.directions, path.directions[-1])

    prisms = [x for x in numbers if x.kind == "deviation"]
    if prisms:
        optics = table.prism(prisms)
        systems.append((optics, prisms, angles(optics, table.deviated)))
    for order in (1, 2):
        bows = [x for x in numbers if x.kind == "rainbow" and x.given["order"] == order]
        if bows:
            optics = table.drop(bows)
            systems.append((optics, bows, angles(optics, table.from_antisolar)))
    lens = [x for x in numbers if x.kind == "double Gauss"]
    if lens:

        def heights(path: optical_systems.Path) -> Any:
            return np.array([table.behind_the_lens(path, x.given["ray"], x.given["slope"]) for x in lens])

        systems.append((optical_systems.double_gauss(), lens, heights))
    critical = [x for x in numbers if x.kind == "critical angle"]
    roundoff = float(np.finfo(PRECISIONS[call.precision]).eps) / 2
    measured = dict[str, tuple[float, float]]()
    paths = together([optics for optics, _, _ in systems], refracting(refract, call.precision))
    for (optics, of_system, reading), path in zip(systems, paths, strict=True):
        bounds = ROUNDED * roundoff * conditions(optics, reading)
        measured |= {x.name: (value, bound) for x, value, bound in zip(of_system, reading(path), bounds, strict=True)}
    return measured | critical_angles(critical, call, refract, roundoff)


def refracting(refract: Refract, precision: str) -> Callable[[Any, Any, Any], Any]:
    """Return (a, n, k) → b by a program, for many rays at once.

    Rays are rotated by ASKEW and rounded to the precision; normals face the rays. NaN where there is no answer.
    """

    def answer(a: Any, n: Any, k: Any) -> Any:
        turn, dtype = optical_systems.ASKEW, PRECISIONS[precision]
        rays = ray_set.facing(regimes.Rays((a @ turn).astype(dtype), (n @ turn).astype(dtype), k.astype(dtype)))
        answers = refract(as_ray_set(rays, precision))
        b = np.full(a.shape, np.nan)
        b[answers.ids] = answers.b
        return optical_systems.unit(b.astype(np.longdouble)) @ turn.T

    return answer


def as_ray_set(rays: regimes.Rays, precision: str) -> RaySet:
    """Return rays as a set with ids and a header, as a program reads them."""
    ids = np.arange(len(rays.k))
    about_rays = {"precision": precision, "seed": 0, "regimes": {"standard numbers": [0, len(ids) - 1]}}
    return ray_set.with_checksum(RaySet(rays, ids, about_rays))


def together(systems: Sequence[Optics], refract: Callable[[Any, Any, Any], Any]) -> list[optical_systems.Path]:
    """Return the paths through all systems; one call of `refract` per step serves all of them."""
    steps = [system.steps() for system in systems]
    paths: list[Any] = [None] * len(systems)
    waiting = {i: next(step) for i, step in enumerate(steps)}  # (a, n, k) of the next refraction, by system
    while waiting:
        requests = list(waiting.values())
        counts = np.cumsum([len(a) for a, _, _ in requests])[:-1]
        a, n = (np.concatenate([request[i] for request in requests]) for i in (0, 1))
        k = np.concatenate([np.broadcast_to(request[2], len(request[0])) for request in requests])
        for i, b in zip(list(waiting), np.split(refract(a, n, k), counts), strict=True):
            try:
                waiting[i] = steps[i].send(b)
            except StopIteration as end:
                paths[i] = end.value
                del waiting[i]
    return paths


def conditions(optics: Optics, reading: Callable[[optical_systems.Path], Any]) -> Any:
    """Return by how many u each reading changes if a, n, k and b of each boundary change by u, worst case."""
    exact = reading(optics.path())
    return optics.condition_of(lambda moved: (reading(optics.path(moved=moved)) - exact)[:, None])


def critical_angles(
    numbers: Sequence[StandardNumber], call: RaysCommand, refract: Refract, roundoff: float
) -> dict[str, tuple[float, float]]:
    """Return the angles, in degrees, beyond which a function signals total internal reflection, and their bounds."""
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
    answers = refract(as_ray_set(rays, call.precision))
    passed = np.zeros(len(angle), bool)
    length = np.linalg.norm(answers.b, axis=1)
    # A direction with a smaller cosine is along the surface, which signals total reflection. The nearest ray of the
    # grid has cos θ_t ≈ √(8 u).
    along = ALONG * roundoff * np.maximum(1, k[answers.ids])
    through = (answers.b * -rays.n[answers.ids]).sum(1) > along
    passed[answers.ids] = through & (length > 0.5) & (True if answers.transmitted is None else answers.transmitted)
    measured = {}
    for number, transmitted in zip(numbers, np.split(passed, len(numbers)), strict=True):
        count = int(transmitted.sum())  # if the signal alternates, this gives its mean place
        place = float(np.interp(count - 0.5, range(GRID), grid)) if 0 < count < GRID else math.nan
        size = math.degrees(spread[number.name])
        measured[number.name] = (number.value + place * size, size * (1 + STEP))
    return measured


# Fresnel's equations ---------------------------------------------------------------------------------------------


def fresnel_rows(title: str, context: Context) -> list[Row]:
    """Return a row per number that reflectances give, or one row with the reason why there are none."""
    fresnel = FRESNEL[title]
    system, numbers, versions = SYSTEMS[fresnel.system], reflected(fresnel.answers), list[str]()
    no_row = functools.partial(Row, NAME, title, "every boundary", fresnel.precision)

    def reflect(rays: RaySet) -> dict[str, Any]:
        data = json.loads(environments.run(environments.script(system, *fresnel.script), as_csv(rays)))
        try:
            versions.append(str(data["system"]))
            answers = {key: np.array(data[key], float) for key in fresnel.answers}
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"no answer: {error!r}; expected system, {', '.join(fresnel.answers)} in JSON") from None
        if {x.shape for x in answers.values()} != {(len(rays),)}:
            raise ValueError(f"{[x.shape for x in answers.values()]} answers; expected {len(rays)} numbers of each")
        return answers

    lost, reason = ("unanswered", float(len(numbers))), environments.why_not(system, context.profile.name)
    answer = functools.partial(measure_reflected, numbers, fresnel.precision, reflect)
    measured, no_answer = environments.attempt(no_row, reason, lost, answer)
    if measured is None:
        return no_answer
    return [row(x, title, fresnel.precision, *measured[x.name], versions[0]) for x in numbers]


def reflected(names: Sequence[str]) -> list[StandardNumber]:
    """Return the numbers that answers of these names give."""
    kinds = {"p": "Brewster's angle", "phase": "retardation"}
    diffuse = [x for x in of_kind("diffuse") if not x.given["passed"]]
    return [*of_kind(*(kind for key, kind in kinds.items() if key in names)), *diffuse]


def measure_reflected(
    numbers: Sequence[StandardNumber], precision: str, reflect: Reflect
) -> dict[str, tuple[float, float]]:
    """Return measured value and bound, by name, of numbers from what a boundary reflects."""
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
    answers = reflect(as_ray_set(regimes.Rays(a, n, np.concatenate(k)), precision))
    ends, measured = np.cumsum([len(x) for x in cosines])[:-1], {}
    for i, (number, read) in enumerate(zip(numbers, reads, strict=True)):
        value, bound = read(cosines[i], {key: np.split(x, ends)[i] for key, x in answers.items()})
        measured[number.name] = float(value), ROUNDED * roundoff * float(bound)
    return measured


Read = Callable[[Any, dict[str, Any]], tuple[Any, Any]]


def reflections(number: StandardNumber, dtype: Any) -> tuple[Any, float, Read]:
    """Return what to measure a number with: cosines of incidence, the ratio of indices n_to/n_from, and `read`.

    `read(cosines, answers)` returns the number and its bound over ROUNDED u.
    """
    n = number.given["n"]
    if number.kind == "Brewster's angle":
        angles = number.value + np.linspace(-REACH, REACH, GRID)
        return np.cos(np.deg2rad(angles)), n, functools.partial(_shifted, number)
    if number.kind == "retardation":
        count, angle = number.given["reflections"], number.given["incidence"]

        def read(cosine: Any, answers: dict[str, Any]) -> tuple[Any, Any]:
            slope = number.slope("n") * n + number.slope("incidence") * np.rad2deg(cosine / np.sqrt(1 - cosine**2))
            return count * np.rad2deg(np.abs(answers["phase"]))[0], slope[0] + count * math.degrees(1)

        return np.cos(np.deg2rad([angle])), 1 / n, read
    outside, inside, weight = closed_forms.nodes(n, dtype)
    cosine, into, share = (outside, n, 1.0) if number.given["outside"] else (inside, 1 / n, 1 / n**2)

    def total(cosine: Any, answers: dict[str, Any]) -> tuple[Any, Any]:
        """Return the diffuse reflectance; 1 − share of the light is beyond the critical angle."""
        power = answers["mean"] if "mean" in answers else (answers["s"] + answers["p"]) / 2
        off = 1 + sum(np.abs(slope).mean(0) for slope in slopes(into, cosine))
        return share * (weight * power).sum() + 1 - share, share * (weight * off).sum()

    return cosine, into, total


def _shifted(number: StandardNumber, cosine: Any, answers: dict[str, Any]) -> tuple[Any, Any]:
    """Return Brewster's angle and its bound: the measured R_p is the exact curve, shifted by least squares.

    To first order in the shift.
    """
    by_cosine, by_index = (x[1] for x in slopes(number.given["n"], cosine))
    slope = by_cosine * np.deg2rad(-np.sqrt(1 - cosine**2) / cosine)  # per degree
    off, weight = reflectances(number.given["n"], cosine)[1] - answers["p"], slope / (slope**2).sum()
    return number.value + (off * weight).sum(), (np.abs(weight) * (1 + np.abs(by_cosine) + np.abs(by_index))).sum()


def reflectances(into: Any, cosine: Any) -> np.ndarray:
    """Return R_s and R_p, 2 × N, for cosines of incidence and the ratio of indices `into` = n_to/n_from."""
    return table.reflectances(into, np.rad2deg(np.arccos(cosine)))[0]


def slopes(into: float, cosine: Any) -> list[np.ndarray]:
    """Return ∂R/∂ln cos_i and ∂R/∂ln into, 2 × N each, in extended precision."""
    up = 1 + np.longdouble(1e-12)
    ways = (1, up), (up, 1)
    return [(reflectances(into * x, cosine * y) - reflectances(into / x, cosine / y)) / (2 * (up - 1)) for x, y in ways]


# Glasses ---------------------------------------------------------------------------------------------------------


def glass_rows(system: System, catalogue: GlassCatalogue, context: Context) -> list[Row]:
    """Return a row per index of a glass that the system has by name, or one row with the reason for none."""
    no_row = functools.partial(Row, NAME, system.title, "every glass", "f64")
    numbers = [x for x in of_kind("index") if x.medium in catalogue.glasses]
    media, lines = list(dict.fromkeys(x.medium for x in numbers)), list(table.LINES.values())
    rays = ray_set.make(["generic"], 4 * len(media) * len(lines), "f64", 0, media=media, wavelengths=lines)

    def answer() -> Answers:
        text = environments.run(environments.script(system, catalogue.script, "glasses"), as_csv(rays))
        return _known(parse_answers(text, system.title), rays)

    lost, reason = ("unanswered", float(len(numbers))), environments.why_not(system, context.profile.name)
    answers, no_answer = environments.attempt(no_row, reason, lost, answer)
    if answers is None:
        return no_answer
    return [
        row(x, system.title, "f64", index, x.print_reading[1], str(answers.header.get("system", "")))
        for x, index in zip(numbers, indices(rays, answers, numbers), strict=True)
        if x.print_reading
    ]


def indices(rays: RaySet, answers: Answers, numbers: Sequence[StandardNumber]) -> list[float]:
    """Return the index that the program used for each number; NaN if there is none."""
    ratio = np.full(len(rays), np.nan)
    if answers.n_ratio is not None:
        ratio[answers.ids] = answers.n_ratio
    wavelength, pair = header.columns(rays.header, rays.ids).T
    names = rays.header["media"]
    index = np.where(ratio > 1, ratio, 1 / ratio)  # the other medium is air
    measured = []
    for number in numbers:
        of_number = [number.medium in names[int(i)] for i in pair] & (wavelength == number.given["nm"])
        measured.append(float(index[of_number].max()) if of_number.any() else math.nan)
    return measured


# Images ----------------------------------------------------------------------------------------------------------


def image_rows(title: str, context: Context) -> list[Row]:
    """Return a row per plate or pile of plates, or one row with the reason why there are none."""
    renderer = IMAGE_RENDERERS[title]
    no_row, system = functools.partial(Row, NAME, title, "every plate", ""), SYSTEMS[renderer.system]
    reason = environments.why_not(system, context.profile.name) or (COMPILED if context.scalar else "")
    seeds = range(1, SEEDS + 1)

    def draw() -> list[np.ndarray]:
        means = []
        for number in plates():
            with tempfile.TemporaryDirectory() as folder:
                images = renderer.draw(plate_scene(number), Path(folder), SPP, seeds)
                means.append(np.array([image.pixels[..., 1].mean(dtype=float) for image in images]))
        return means

    by_plate, no_answer = environments.attempt(no_row, reason, ("unanswered", float(len(plates()))), draw)
    if by_plate is None:
        return no_answer
    setting = f"{PIXELS}², {SEEDS} seeds"
    return [
        row(number, title, setting, *mean_and_bound(means), system.source)
        for number, means in zip(plates(), by_plate, strict=True)
    ]


def mean_and_bound(means: np.ndarray) -> tuple[float, float]:
    """Return the mean of the images' means, and the bound of its error."""
    from scipy import stats

    chance = stats.t.isf(limits.FALSE_ALARM / 2, len(means) - 1) * means.std(ddof=1) / math.sqrt(len(means))
    return float(means.mean()), float(chance + HALF_FLOAT * means.mean())


def plate_scene(number: StandardNumber) -> PlainScene:
    """Return plates normal to z, a lamp of radiance 1 behind them that fills the view, and a camera at an angle."""
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
    """Return a plate from z to z + THICK, with outward normals."""
    x, y, w = np.meshgrid([-WIDE, WIDE], [-WIDE, WIDE], [z, z + THICK], indexing="ij")
    vertices = np.stack([x, y, w], axis=-1).reshape(-1, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])
    return Mesh(name, vertices, faces, material)


STUDY = Study(NAME, "Standard numbers by others", about(__doc__), TERMS, tasks)
