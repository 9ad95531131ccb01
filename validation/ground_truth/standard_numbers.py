"""Standard numbers: published and closed-form values, measured through `refract` in Mitsuba.

The numbers are those of `validation/reference/standard_numbers.py`, each with its law, its source and, if a source
prints it, its digits. Plates are rendered by `refract_path` without noise: both lobes are followed at twelve
boundaries, and paths end behind them. A pile of four plates is rendered by Mitsuba's `path`, with noise. The variants
are polarised, except for numbers in which each boundary transmits the mean of both polarisations. Prisms, drops and the
double Gauss are traced as in the ground truth. The rhomb is a shape in Mitsuba; its retardation δ follows from the
Mueller matrix of a ray through it, whose last element is cos δ. Brewster's and the critical angle are searched, diffuse
shares come from the BSDF's probabilities at the nodes of a quadrature, indices from the ratio that a sample returns.

The error is divided by its bound, the sum of all rounding errors of float32 at their worst, unless stated otherwise;
u = 2⁻²⁴.

- Plates. The ray's direction rotates by 39u at each boundary (see `ground_truth/bench.py`), twelve times; the
  transmittance of each polarisation changes by this times its slope. The error of a weight is 45u per boundary with
  Mueller matrices: 16u for the products of amplitudes, four rotations and a product of 5u each, 4u for lobes. Without
  them it is 8u. A path counts once per boundary that it meets. The light after more than twelve boundaries is missing.
  In an absorbing plate Mitsuba's offset along the normal shortens a ray by sin²θ of the offset.
- Four plates: Student's t over 16 sets of samples, which chance exceeds once in ten thousand runs, plus these errors.
- Rays: the rounding errors of `ground_truth/bench.py` in each component, as independent ones. With c the largest effect
  of each, their sum exceeds √(2 ln(2/p) Σ c²) with a probability p (Hoeffding), here once in ten thousand runs.
- Retardation: 39u three times, times its slope, and four weights over sin δ.
- Brewster's and the critical angle: 8u for the sines and cosines of a direction, 2u for the ratio of indices.
- Diffuse shares: `limits.DIFFUSE`. Indices: 3u for the ratio, and the rounded wavelength; for glTF's formula, half a
  unit of the last printed digit of its three constants.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.plugins import PLUGIN
from mi_refract.plugins.refract import followed_context
from mi_refract.report.row import Reason, Row
from validation import limits
from validation.reference import closed_forms, optical_systems
from validation.reference import standard_numbers as table
from validation.reference.standard_numbers import StandardNumber
from validation.run.bsdf_sampling import OFFSET, sample_all
from validation.run.context import Context
from validation.run.metrics import ERROR_OVER_BOUND
from validation.run.render_methods import under
from validation.study import Study, Task, about

from . import bench
from .bench import FIRST, INTO, NORMAL, ONWARD, Bench, U, glass

NAME = "standard numbers"
MEASURED, EXACT, PRINTED, BOUND, SECONDS = "measured", "exact", "printed", "bound", "seconds"
INDEX_SEEN = "index seen"
COMPILED = {"plain": "llvm_ad_mono", "spectral": "llvm_ad_spectral", "polarised": "llvm_ad_mono_polarized"}
# Variants of the profile `quick`, and of runs without a compiled variant: one has polarisation and wavelengths.
SCALAR = {"plain": "scalar_rgb", "spectral": "scalar_spectral", "polarised": "scalar_spectral_polarized"}
TERMS = dict(table.KINDS) | {
    EXACT: "the law in extended precision",
    PRINTED: "the printed number, if an available source prints it",
    BOUND: "the bound on |measured − exact|",
    INDEX_SEEN: "the relative error of the index that moves the number to its bound",
    SECONDS: "time of the measurement, divided among the numbers that one render measures",
}
BOUNDARIES = 12  # on a path through plates: a sample splits into at most 4096 paths
THICKNESS, HALF_SIZE, FAR = 200.0, 6000.0, 1e4  # of plates, whose distance equals their thickness
TURN = NORMAL + INTO + ONWARD
WEIGHT, PLAIN_WEIGHT = 45.0, 8.0
SAMPLES = {"standard": 1 << 18, "full": 1 << 22}  # for a pile of four plates
SETS = 16
NM = 550.0  # for variants that need a wavelength
ANGLE, RATIO = 8.0, 2.0
SMALL = 1e-7  # step of difference quotients in extended precision


@dataclass(frozen=True)
class Measured:
    """The plugin's value of a number, and the bound on its difference from the law."""

    value: float
    bound: float
    seconds: float = 0.0


def tasks(context: Context) -> list[Task]:
    """Return one task per variant. Piles of plates, which take thousands of paths, need a compiled variant."""
    return [Task(f"{NAME}: {need}", functools.partial(rows, need, context), timed=True) for need in COMPILED]


def rows(needed: str, context: Context) -> list[Row]:
    """Return a row per number that needs a variant; scalar variants do not measure piles of plates."""
    scalar = context.profile.quick or context.scalar
    numbers = [number for number in table.NUMBERS.values() if need(number) == needed]
    variant = (SCALAR if scalar else COMPILED)[needed]
    if (reason := context.variants.get(variant, "not in this wheel")) is not None:
        return [Row(NAME, PLUGIN, number.name, variant, reason=reason) for number in numbers]
    feasible = [number for number in numbers if not (scalar and number.given.get("count", 1) > 1)]
    with under(variant):
        results = measure(feasible, SAMPLES.get(context.profile.name, 0))
    pile = Reason("a pile of plates takes thousands of paths", "`--profile standard` with a compiled variant")
    return [
        row(number, results[number.name], PLUGIN, variant)
        if number.name in results
        else Row(NAME, PLUGIN, number.name, variant, reason=pile)
        for number in numbers
    ]


def noisy(number: StandardNumber) -> bool:
    """Return whether a number is measured with noise: after twelve boundaries of such a pile too much light is left."""
    return number.given.get("count", 1) > 2


def row(number: StandardNumber, result: Measured, subject: str, setting: str) -> Row:
    """Return the row of a number, with its error over its bound."""
    printed = number.print_reading
    values = {MEASURED: result.value, EXACT: number.value} | ({PRINTED: printed[0]} if printed else {})
    error = abs(result.value - number.value)
    values |= {BOUND: result.bound, ERROR_OVER_BOUND: error / result.bound, SECONDS: result.seconds}
    remark = "; ".join(filter(None, (number.source, number.fitted and f"fitted: {number.fitted}")))
    budgets, replay = {ERROR_OVER_BOUND: limits.STANDARD}, {"law": number.formula, **number.given}
    if "n" in number.given and not noisy(number):
        values[INDEX_SEEN] = result.bound / (number.slope("n") * number.given["n"])
        budgets[INDEX_SEEN] = limits.STANDARD_SEEN
    return Row(NAME, subject, number.name, setting, values, budgets, reason=remark, replay=replay)


def need(number: StandardNumber) -> str:
    """Return what a number's variant of Mitsuba must have."""
    if "nm" in number.given:
        return "spectral"
    return "polarised" if number.kind in ("transmittance", "retardation", "Brewster's angle") else "plain"


def measure(numbers: Sequence[StandardNumber], samples: int = 0) -> dict[str, Measured]:
    """Measure numbers in the current variant; return them by name. `samples`: for a pile of plates."""
    results: dict[str, Measured] = {}
    groups: dict[tuple[Any, ...], list[StandardNumber]] = {}
    for number in numbers:
        groups.setdefault((number.kind, *_together(number)), []).append(number)
    for (kind, *_), group in groups.items():
        start = time.perf_counter()
        answers = MEASURES[kind](group, samples)
        seconds = (time.perf_counter() - start) / len(group)
        pairs = zip(group, answers, strict=True)
        results |= {x.name: Measured(float(value), float(bound), seconds) for x, (value, bound) in pairs}
    return results


def _together(number: StandardNumber) -> tuple[Any, ...]:
    """Return a key: numbers with the same key are measured by one render."""
    if number.kind.startswith("transmittance"):
        return tuple(number.given.get(name) for name in ("n", "count", "absorbance"))
    return () if number.kind == "double Gauss" else (number.name,)


Answers = list[tuple[Any, Any]]  # value and bound of each number of a group


# Plates ----------------------------------------------------------------------------------------------------------


def transmittances(group: Sequence[StandardNumber], samples: int) -> Answers:
    """Measure one plate or pile at the angles of all numbers: the radiance of a lamp of radiance 1 behind it."""
    import mitsuba as mi

    noise = noisy(group[0])
    integrator: dict[str, Any] = {"type": "path" if noise else "refract_path", "max_depth": -1, "rr_depth": 1 << 20}
    if not noise:
        integrator |= {"split_depth": BOUNDARIES, "split_weight": 0.0, "max_depth": BOUNDARIES + 1}
    scene: Any = mi.load_dict(_plates(group[0]) | {"integrator": integrator})
    angles = np.deg2rad([number.given["incidence"] for number in group])
    d = np.stack([np.sin(angles), 0 * angles, np.cos(angles)])
    radiances = _radiances(scene, np.repeat(d, samples if noise else 1, axis=1))
    means, chance = radiances.reshape(len(group), SETS if noise else 1, -1).mean(2), np.zeros(len(group))
    if noise:
        from scipy import stats

        chance = stats.t.isf(limits.FALSE_ALARM / 2, SETS - 1) * means.std(1, ddof=1) / math.sqrt(SETS)
    bounds = [plates_bound(number) + x for number, x in zip(group, chance, strict=True)]
    return list(zip(means.mean(1), bounds, strict=True))


def _radiances(scene: Any, d: np.ndarray) -> np.ndarray:
    """Return the integrator's radiances of rays along d (3 × N) that hit the first plate on the axis."""
    import mitsuba as mi

    o, sampler = np.array([[0], [0], [-THICKNESS / 2]]) - THICKNESS * d, mi.load_dict({"type": "independent"})
    vectorised = dr.is_jit_v(mi.Float)
    sampler.seed(0, d.shape[1] if vectorised else 1)

    def radiance(o: Any, d: Any) -> Any:
        ray: Any = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
        if mi.is_spectral:
            ray.wavelengths = type(ray.wavelengths)(NM)
        return np.array(scene.integrator().sample(scene, sampler, ray)[0], float)

    if vectorised:
        return np.asarray(radiance(o, d).reshape(-1, d.shape[1])[0])
    return np.array([radiance(*ray).ravel()[0] for ray in zip(o.T, d.T, strict=True)])


def plates_bound(number: StandardNumber) -> float:
    """Return the bound for plates: see the module."""
    polarised = number.kind == "transmittance"
    given: dict[str, Any] = {**number.given, "together": not polarised}

    def slope(name: str) -> float:
        """Return Σ |∂T/∂given|/count: errors of the polarisations do not cancel."""
        ends = [table.polarised_plates(**{**given, name: np.longdouble(given[name]) + x}) for x in (SMALL, -SMALL)]
        return float(np.abs(ends[0] - ends[1]).mean() / (2 * SMALL))

    leaving, remaining = table.paths_through(BOUNDARIES, **given)
    boundaries = np.arange(1, BOUNDARIES + 1) @ leaving + BOUNDARIES * remaining
    total = slope("incidence") * math.degrees(FIRST + BOUNDARIES * TURN) * U + slope("n") * given["n"] * RATIO * U
    total += (WEIGHT if polarised else PLAIN_WEIGHT) * U * float(boundaries.mean())
    if not noisy(number):
        total += float((table.polarised_plates(**given) - leaving.sum(0)).mean())
    if "absorbance" in given:
        sine = math.sin(math.radians(given["incidence"])) / given["n"]
        shortening = OFFSET * (1 + 4 * THICKNESS) / THICKNESS * sine**2 + BOUNDARIES * bench.PLACE * U
        total += slope("absorbance") * given["absorbance"] * shortening
    return float(total)


def _plates(number: StandardNumber) -> dict[str, Any]:
    """Return plates perpendicular to z, the first one around the origin, and a lamp behind them."""
    import mitsuba as mi

    move, given = mi.ScalarTransform4f, number.given
    material = glass(PLUGIN, given["n"])
    if "absorbance" in given:
        material["int_absorption"] = given["absorbance"] / THICKNESS
    parts: dict[str, Any] = {"type": "scene"}
    for i in range(round(given.get("count", 1))):
        place = move().translate([0, 0, 2 * i * THICKNESS]).scale([HALF_SIZE, HALF_SIZE, THICKNESS / 2])
        parts[f"plate_{i}"] = {"type": "cube", "to_world": place, "bsdf": material}
    behind = move().translate([0, 0, FAR]).scale(20 * FAR).rotate([1, 0, 0], 180)
    light = {"type": "area", "radiance": {"type": "uniform", "value": 1.0}}
    lamp = {"type": "rectangle", "to_world": behind, "light": light}
    return parts | {"lamp": lamp | {"bsdf": {"type": "diffuse", "reflectance": 0.0}}}


# Rays ------------------------------------------------------------------------------------------------------------


Readings = Sequence[tuple[int, Callable[[optical_systems.Path], Any]]]  # index of a ray, function that reads its path


def traced_angle(group: Sequence[StandardNumber], samples: int) -> Answers:
    """Measure the deviation by a prism, or the angle of a rainbow."""
    return _read(*angle_read(*group))


def angle_read(number: StandardNumber) -> tuple[Bench, Readings]:
    """Return the prism or the drop with its ray, and the function that reads the angle from a path."""
    if number.kind == "deviation":
        medium = number.medium or number.given["n"]  # a glass by name, or an index
        angle, nm = table.deviated, number.given.get("nm")
        case = Bench(table.prism([number]), lambda plugin: bench.prism(plugin, medium), nm)
    else:
        angle = table.from_antisolar
        case = Bench(table.drop([number]), lambda plugin: bench.ball(plugin, number.given["n"]))
    return case, [(0, lambda path: angle(case.system.directions, path.directions[-1])[0])]


def double_gauss(group: Sequence[StandardNumber], samples: int) -> Answers:
    """Measure rays through the lens of the ground truth."""
    keys = [(number.given["ray"], number.given["slope"]) for number in group]
    readings = [(round(key[0]), functools.partial(table.behind_the_lens, ray=key[0], slope=key[1])) for key in keys]
    return _read(bench.benches()["double Gauss"], readings)


def _read(case: Bench, readings: Readings) -> Answers:
    """Return for each reading its value for the traced path, and its bound."""
    path = case.traced(PLUGIN)
    return list(zip([read(path) for _, read in readings], read_bounds(case, readings), strict=True))


def read_bounds(case: Bench, readings: Readings) -> list[float]:
    """Return bounds by Hoeffding's inequality: Σ effect²/count sums the squares of single roundings."""
    exact, squares = case.system.path(), [0.0] * len(readings)

    def changes(moved: optical_systems.Path) -> optical_systems.Answers:
        return {str(i): read(moved) - read(exact) for i, (_, read) in enumerate(readings)}

    for count, effect in case.effects(changes):
        for i, (ray, _) in enumerate(readings):
            squares[i] += float(effect[str(i)][ray, 0]) ** 2 / count
    return [math.sqrt(2 * math.log(2 / limits.FALSE_ALARM) * square) for square in squares]


# The BSDF --------------------------------------------------------------------------------------------------------


def retardation(group: Sequence[StandardNumber], samples: int) -> Answers:
    """Measure a rhomb: its end faces are perpendicular to the ray, which hits the long faces at the acute angle."""
    import mitsuba as mi

    (number,) = group
    angle = math.radians(number.given["incidence"])
    matrix = np.eye(4)
    matrix[0, 0], matrix[0, 2] = 2 * math.tan(angle), 1 / math.tan(angle)
    place = mi.ScalarTransform4f(matrix.tolist())
    shape = {"type": "cube", "to_world": place, "bsdf": glass(PLUGIN, number.given["n"])}
    scene: Any = mi.load_dict({"type": "scene", "rhomb": shape})
    d = np.array([math.sin(angle), 0, -math.cos(angle)])
    start = np.array([-matrix[0, 0], 0, 0]) - 2 * d
    ray: Any = mi.Ray3f(mi.Point3f(start), mi.Vector3f(d))
    total: Any = mi.Spectrum(1)
    context = followed_context()
    for lobe in (1, 0, 0, 1):
        si = scene.ray_intersect(ray)
        context.component = lobe
        sample, weight = si.bsdf().sample(context, si, 0.5, [0.5, 0.5])
        total = total @ si.to_world_mueller(weight, -sample.wo, si.wi)
        ray = si.spawn_ray(si.to_world(sample.wo))
    mueller = np.array(total, float).reshape(4, 4, -1)[..., 0]
    both = math.acos(mueller[3, 3] / mueller[0, 0])
    share = number.given["reflections"] / 2
    bound = number.slope("incidence") * math.degrees(FIRST + 3 * TURN) + number.slope("n") * number.given["n"] * RATIO
    return [(math.degrees(both) * share, U * (bound + math.degrees(4 * WEIGHT / math.sin(both)) * share))]


def brewster(group: Sequence[StandardNumber], samples: int) -> Answers:
    """Measure the angle at which the last element of the Mueller matrix, r_s r_p, changes its sign."""
    (number,) = group
    angle = _crossing(number.given["n"], lambda bsdf, wi: _sampled(bsdf, wi, 0)["weight"][:, -1])
    return [(angle, _angle_bound(number))]


def critical(group: Sequence[StandardNumber], samples: int) -> Answers:
    """Measure the angle beyond which nothing is transmitted."""
    import mitsuba as mi

    (number,) = group

    def reflected(bsdf: Any, wi: Any) -> Any:
        return np.where(_sampled(bsdf, wi, 1)["type"] == int(mi.BSDFFlags.DeltaTransmission), -1.0, 1.0)

    return [(_crossing(1 / number.given["n"], reflected), _angle_bound(number))]


def _angle_bound(number: StandardNumber) -> float:
    return U * float(math.degrees(ANGLE) + number.slope("n") * number.given["n"] * RATIO)


def _sampled(bsdf: Any, wi: np.ndarray, lobe: int) -> dict[str, np.ndarray]:
    """Sample one lobe, 0 or 1, by the random number 0 or 1 − u."""
    import mitsuba as mi

    return sample_all(bsdf, mi.BSDFContext(), wi, np.full(len(wi), lobe * (1 - 2 * U)))


def _crossing(ratio: float, sign: Callable[[Any, Any], np.ndarray]) -> float:
    """Return the angle in degrees at which `sign(bsdf, wi)` changes; from inside if `ratio` = n_to/n_from < 1."""
    import mitsuba as mi

    bsdf: Any = mi.load_dict(glass(PLUGIN, max(ratio, 1 / ratio)))
    low, high, side = 0.01, 89.99, 1 if ratio > 1 else -1
    for _ in range(5):
        angles = np.linspace(low, high, 65)
        wi = np.stack([np.sin(np.deg2rad(angles)), 0 * angles, side * np.cos(np.deg2rad(angles))], axis=1)
        values = sign(bsdf, wi)
        changes = np.flatnonzero(np.signbit(values[1:]) != np.signbit(values[:-1]))
        if not len(changes):
            return math.nan
        low, high = angles[changes[0]], angles[changes[-1] + 1]
    return float(low + high) / 2


def diffuse(group: Sequence[StandardNumber], samples: int) -> Answers:
    """Measure probabilities of the lobe at the nodes; inside, 1 − 1/n² of all light is beyond the critical angle."""
    import mitsuba as mi

    (number,) = group
    n, passed = number.given["n"], bool(number.given["passed"])
    outside, inside, weight = closed_forms.nodes(n, np.float32)
    cosine = (outside if number.given["outside"] else -inside).astype(float)
    wi = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], axis=1)
    share = 1.0 if number.given["outside"] else 1 / n**2
    powers = _sampled(mi.load_dict(glass(PLUGIN, n)), wi, int(passed))["pdf"][:, 0]
    value = share * float((weight * powers).sum()) + (0 if passed else 1 - share)
    return [(value, limits.DIFFUSE * U * number.value)]


def index(group: Sequence[StandardNumber], samples: int) -> Answers:
    """Measure the ratio of indices of a sample at normal incidence, at the wavelength."""
    import mitsuba as mi

    (number,) = group
    given, nm = number.given, number.given["nm"]
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi, si.wavelengths = mi.Vector3f(0, 0, 1), type(si.wavelengths)(nm)
    sample, _ = mi.load_dict(glass(PLUGIN, number.medium.format(**given))).sample(
        followed_context(), si, 1 - 2 * U, [0.5, 0.5]
    )
    bound = U * (3 * number.value + number.slope("nm") * nm)
    if number.law is table.khronos:
        bound += (given["n_d"] - 1) / given["abbe"] * (0.5 / nm**2 + 0.5e-4)
    return [(np.array(sample.eta, float).ravel()[0], bound)]


MEASURES: dict[str, Callable[[Sequence[StandardNumber], int], Answers]] = {
    "transmittance": transmittances,
    "transmittance, unpolarised": transmittances,
    "deviation": traced_angle,
    "rainbow": traced_angle,
    "Brewster's angle": brewster,
    "critical angle": critical,
    "retardation": retardation,
    "diffuse": diffuse,
    "index": index,
    "double Gauss": double_gauss,
}
STUDY = Study(NAME, "Standard numbers", about(__doc__), TERMS, tasks)
