"""All BSDFs of Mitsuba beside, around and within glass: does `refract_path` render what `path` renders?

Each BSDF is tested alone and in every wrapper that Mitsuba allows. The features of a scene decide what `refract_path`
leaves out, so BSDFs share an image only if each of them alone has the same features. The mean of many independent
pixels with few samples each is compared with one image of many samples by `path`: more pixels reduce the noise, but not
a bias that depends on the sample count. There is a test for the mean of each BSDF over all settings, of each setting
over all BSDFs, and of each BSDF in each setting. Random numbers depend on the sample count and the split depth, lobes
on the BSDF: two BSDFs are rendered with every count, the others with one count per split depth. In spectral and
polarised variants, only `diffuse` and the BSDFs with delta lobes are tested; only delta lobes are split. `path` renders
null lobes as `volpath` does, so it is the reference for all.
"""

from __future__ import annotations

import functools
import gc
import itertools
import statistics
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refract.formulas import FORMULAS
from mi_refract.plugins import inspect
from mi_refract.report.row import Row
from validation import limits
from validation.run.context import Context
from validation.run.render_methods import OURS
from validation.run.seeds import current

from .cases import BLACK, GLASS, TURNED, Case, Nodes, bitmap, flat, study, variants

TERMS = {
    "alarms": "means that differ by more than noise does once in 10⁸ tests: of all, of one setting, or of one cell",
    "difference": "of the mean over all settings, or over all BSDFs, relative to that of `path`",
    "detectable": "relative difference of that mean that its test detects with probability 1/2",
    "detectable, each": "the largest such difference of one BSDF in one setting",
}
NAME = "neighbours"
SEED = 2041
SIGMAS = statistics.NormalDist().inv_cdf(1 - limits.NEIGHBOUR_ALARM / 2)
ROUNDING = 1e-5  # relative rounding error of the mean of a float32 image, for images without noise
TURN, ROUGH, MIXED = {"theta": 30.0}, {"alpha": 0.3}, {"roughness": 0.4, "spec_trans": 0.5}
DELTA: dict[str, Nodes] = {name: {} for name in ("dielectric", "thindielectric", "null", "circular")}
DELTA |= {"conductor": {"specular_reflectance": 0.8}, "polarizer": TURN, "retarder": TURN, "refract": GLASS}
SMOOTH: dict[str, Nodes] = {name: {} for name in ("diffuse", "plastic", "hair", "measured", "measured_polarized")}
SMOOTH |= {f"rough{name}": ROUGH for name in ("dielectric", "conductor", "plastic")} | {"pplastic": ROUGH}
SMOOTH |= {"principled": MIXED | {"clearcoat": 0.5, "sheen": 0.5}, "principledthin": MIXED | {"diff_trans": 0.8}}
BSDFS = DELTA | SMOOTH | {f"refract_{formula}": GLASS for formula in FORMULAS}
WRAPPERS: dict[str, Callable[[Nodes], Nodes]] = {
    "alone": lambda bsdf: bsdf,
    "mask": lambda bsdf: {"type": "mask", "opacity": 0.6, "b": bsdf},
    "blendbsdf": lambda bsdf: {"type": "blendbsdf", "weight": 0.3, "a": bsdf, "b": GLASS},
    "twosided": lambda bsdf: {"type": "twosided", "b": bsdf},
    "bumpmap": lambda bsdf: {"type": "bumpmap", "arbitrary": uneven((8, 8), 0.0, 0.1), "b": bsdf},
    "normalmap": lambda bsdf: {"type": "normalmap", "normalmap": flat(TURNED), "b": bsdf},
}
# Mitsuba rejects BSDFs that need a file, which is missing here; `twosided` takes only those of OPAQUE.
NEEDS_FILE = ("measured", "measured_polarized")
OPAQUE = ("conductor", "diffuse", "plastic", "pplastic", "roughconductor", "roughplastic")
Settings = tuple[tuple[int, int], ...]  # split depth, samples per pixel
SETTINGS: dict[str, Settings] = {
    "alone": ((0, 8), (1, 4), (3, 16)),
    "mask": ((0, 2), (1, 16), (3, 25)),
    "blendbsdf": ((0, 16), (1, 4), (3, 2)),
    "twosided": ((0, 64), (1, 64), (3, 8)),
    "bumpmap": ((0, 32), (1, 25), (3, 4)),
    "normalmap": ((0, 4), (1, 2), (3, 32)),
}
COUNTS = (2, 4, 8, 16, 32, 64, 25)
# Parameters, and samples of a cell by `path`; all settings of `refract_path` together have as many. If emitters are
# hidden, alpha is compared, otherwise colours.
LONG, SHORT = {"max_depth": 6, "rr_depth": 3}, {"max_depth": 2, "hide_emitters": True}
WAYS = {"": (LONG, 320_000), "every count": (LONG, 4_000_000), "alpha": (SHORT, 320_000)}
# In the profile `quick`, with 4 samples and one split.
QUICK = {"alone": ("diffuse", "dielectric"), "blendbsdf": ("dielectric",), "normalmap": ("refract",)}


# Scenes of one BSDF with glass, as cells of one scene. Bars, a grille before the lamp and a sky of hard blocks make the
# image depend on every random number.
WIDE = 6  # cells per row


def uneven(shape: tuple[int, int], low: float, high: float, grain: int = 1) -> Nodes:
    """Return a bitmap of random blocks of two values: hard edges at every scale."""
    blocks = np.random.default_rng(3).random(shape) < 0.5
    return bitmap(np.kron(np.where(blocks, high, low), np.ones((grain, grain)))[..., None] * np.ones(3))


def bars(place: Any, spans: Iterable[tuple[float, float]], name: str) -> Nodes:
    """Return black bars across the square [-1, 1]² transformed by `place`; `spans`: their ranges of x."""
    parts = [mi.ScalarTransform4f().translate([(a + b) / 2, 0, 0]).scale([(b - a) / 2, 1, 1]) for a, b in spans]
    bar = {"type": "rectangle", "bsdf": BLACK}
    return {f"{name}{i}": bar | {"to_world": place @ part} for i, part in enumerate(parts)}


def lights(variant: str) -> Nodes:
    """Return a lamp behind a grille, and a sky, which is uniform in spectral variants without polarisation."""
    place = mi.ScalarTransform4f
    down = place().translate([0, 0, 12]).rotate([1, 0, 0], 180).scale(8)
    spans = [(-1, -0.5), (0, 0.25), (0.5, 0.625), (0.75, 0.8125), (0.9375, 0.96875)]  # edges at every scale
    nodes = {"lamp": {"type": "rectangle", "to_world": down, "emitter": {"type": "area", "radiance": 0.8}}}
    nodes |= bars(place().translate([0, 0, -0.1]) @ down, spans, "down")
    nodes |= bars(place().translate([0, 0, -0.2]) @ down @ place().rotate([0, 0, 1], 90), spans, "across")
    if variant.endswith("spectral"):
        return nodes | {"sky": {"type": "constant", "radiance": 0.4}}
    sky = {"type": "envmap", "bitmap": uneven((64, 128), 0.3, 0.8, grain=4)["bitmap"]}
    return nodes | {"sky": sky | {"to_world": place().rotate([1, 0.3, 0.2], 70)}}


def _ball(bsdf: Nodes, radius: float, *center: float) -> Nodes:
    return {"type": "sphere", "center": center, "radius": radius, "bsdf": bsdf}


def _plate(bsdf: Nodes, angle: float, width: float, x: float, y: float) -> Nodes:
    turned = mi.ScalarTransform4f().translate([x, y, 0]).rotate([0, 1, 0], angle)
    return {"type": "rectangle", "to_world": turned.scale([width, 0.48, 1]), "bsdf": bsdf}


def beside(bsdf: Nodes, x: float, y: float) -> Nodes:
    """Return a plate at an angle at which a tilted normal rejects a lobe, a ball of glass, and bars before both."""
    over = mi.ScalarTransform4f().translate([x, y, 1.2]).scale(0.48)
    nodes = bars(over, [(-0.8, -0.6), (0.1, 0.2), (0.7, 0.9)], "bar")
    return nodes | {"plate": _plate(bsdf, 65, 1.1, x, y), "ball": _ball(GLASS, 0.2, x + 0.1, y, 0.5)}


def around(bsdf: Nodes, x: float, y: float) -> Nodes:
    """Return a ball around a ball of glass."""
    return {"outer": _ball(bsdf, 0.46, x, y, 0), "inner": _ball(GLASS, 0.22, x, y, 0.1)}


def within(bsdf: Nodes, x: float, y: float) -> Nodes:
    """Return a plate in a block of glass: all its light comes through the boundary."""
    block = mi.ScalarTransform4f().translate([x, y, 0]).scale([0.49, 0.49, 0.3])
    return {"block": {"type": "cube", "to_world": block, "bsdf": GLASS}, "plate": _plate(bsdf, 10, 0.48, x, y)}


CELLS = (beside, around, within)


def scene(bsdfs: Iterable[Nodes], variant: str) -> Any:
    """Return a scene with the cells of all BSDFs, in rows of `WIDE`."""
    nodes: Nodes = {"type": "scene"} | lights(variant)
    for i, bsdf in enumerate(bsdfs):
        nodes[f"bsdf{i}"] = bsdf | {"id": f"bsdf{i}"}
        for j, cell in enumerate(CELLS, len(CELLS) * i):
            parts = cell({"type": "ref", "id": f"bsdf{i}"}, j % WIDE + 0.5, j // WIDE + 0.5)
            nodes |= {f"{name} {j}": part for name, part in parts.items()}
    return mi.load_dict(nodes, parallel=False, optimize=False)


def measured(view: Any, bsdfs: int, method: Nodes, spp: int, samples: float, seed: int) -> Any:
    """Return means and squared standard errors (2 × BSDFs × cells) of two renders with at least `samples` per cell."""
    tall, pixels = -(-bsdfs * len(CELLS) // WIDE), max(8, round((samples / 2 / spp) ** 0.5))
    film = {"type": "hdrfilm", "width": WIDE * pixels, "height": tall * pixels, "rfilter": {"type": "box"}}
    place = mi.ScalarTransform4f().look_at([WIDE / 2, tall / 2, 3], [WIDE / 2, tall / 2, 0], [0, 1, 0])
    sensor = {"type": "orthographic", "film": film | {"pixel_format": "rgba"}, "sampler": {"type": "independent"}}
    camera = mi.load_dict(sensor | {"to_world": place.scale([WIDE / 2, WIDE / 2, 1])})
    integrator = mi.load_dict(method)
    pair = [np.array(mi.render(view, sensor=camera, integrator=integrator, spp=spp, seed=seed + i)) for i in (0, 1)]
    channels = np.s_[..., 3:] if "hide_emitters" in method else np.s_[..., :3]
    cells = np.array(pair, float)[channels].mean(-1)[:, ::-1].reshape(2, tall, pixels, WIDE, pixels)
    noise = np.square(cells[0] - cells[1]).sum((1, 3)) / 4 / pixels**4
    means = np.stack([cells.mean((0, 2, 4)), noise]).reshape(2, -1)[:, : bsdfs * len(CELLS)]
    return means.reshape(2, bsdfs, len(CELLS))


def cases(context: Context) -> Iterator[Case]:
    """Yield one case per variant and wrapper; in the profile `quick`, a few BSDFs in the variant of the run."""
    rgb = context.variant
    settings: list[Any] = [(rgb, wrapper, names, ((1, 4),), "") for wrapper, names in QUICK.items()]
    if not context.profile.quick:
        every, few = (*DELTA, *SMOOTH), (*DELTA, "diffuse")
        settings = [
            (variant, wrapper, tuple(BSDFS) if wrapper == "alone" else every if variant == rgb else few, counts, "")
            for variant in variants(context)
            for wrapper, counts in SETTINGS.items()
        ]
        counts = (0, 4), (0, 25), *itertools.product((1, 3), COUNTS)
        settings.append((rgb, "alone", ("diffuse", "plastic"), counts, "every count"))
        masked = ("null", "dielectric", "diffuse")
        settings += [(rgb, wrapper, masked, ((0, 4), (1, 4)), "alpha") for wrapper in ("alone", "mask")]
    for setting in settings:
        title = " ".join(setting[:2]) + (f", {setting[-1]}" if setting[-1] else "")
        yield Case(title, setting[0], functools.partial(rows, *setting))


def rows(variant: str, wrapper: str, names: tuple[str, ...], settings: Settings, way: str = "") -> list[Row]:
    """Return a row per BSDF and per setting. BSDFs that Mitsuba rejects are not run, with Mitsuba's message.

    RuntimeError if it rejects others than it is known to reject.
    """
    groups: dict[Any, dict[str, Nodes]] = {}  # features of a scene → its BSDFs
    title, seed, (parameters, samples) = f"{wrapper}, {way}" if way else wrapper, current(SEED), WAYS[way]
    row, table = functools.partial(Row, NAME, OURS), list[Row]()
    for name in names:
        bsdf = WRAPPERS[wrapper](BSDFS[name] | {"type": name})
        try:
            view = scene([bsdf], variant)
        except RuntimeError as error:
            if name not in NEEDS_FILE and (wrapper != "twosided" or name in OPAQUE):
                raise
            reason = str(error).rpartition("[")[2].partition("] ")[2].partition("\n")[0]
            table.append(row(f"{title}: {name}", variant, reason=f"Mitsuba: {reason}"))
        else:
            groups.setdefault(inspect(view), {})[name] = bsdf
    seeds = itertools.count(seed, 2)  # each image has seeds of its own: the errors of different groups are added
    parts = []
    for group in groups.values():
        gc.collect()  # Dr.Jit compiles every BSDF in memory
        measure = functools.partial(measured, scene(group.values(), variant), len(group))
        expected = measure({"type": "path"} | parameters, 64, samples, next(seeds))
        ours = [
            measure({"type": OURS, "split_depth": depth} | parameters, spp, samples / len(settings), next(seeds))
            for depth, spp in settings
        ]
        parts.append((*np.stack(ours, 1), *expected))
    test, noise, means, uncertain = (np.concatenate(part, -2) for part in zip(*parts, strict=True))
    cases: dict[str, Any] = {name: np.s_[:, [i]] for i, name in enumerate(itertools.chain(*groups.values()))}
    cases |= {f"split {depth}, {spp} spp": np.s_[[i], :] for i, (depth, spp) in enumerate(settings)}
    budgets, replay = {"alarms": 0.0, "detectable": limits.NEIGHBOUR}, {"seed": seed, "samples": samples}
    judge = {case: judged(test[x], noise[x], means[x[1]], uncertain[x[1]]) for case, x in cases.items()}
    return [row(f"{title}: {case}", variant, values, budgets, replay=replay) for case, values in judge.items()] + table


def judged(test: Any, noise: Any, expected: Any, uncertain: Any) -> dict[str, float]:
    """Return the values of a row from the means and squared standard errors by setting, BSDF and cell."""
    cells = test - expected, noise + uncertain, expected + 0 * test
    each_bsdf = tuple(x.sum(-1) for x in cells)
    whole = cells[0].mean(0).sum(), noise.sum() / len(test) ** 2 + uncertain.sum(), expected.sum()
    alarms, detectable = 0, []
    for difference, variance, mean in (cells, each_bsdf, whole):
        error = np.sqrt(variance + np.square(ROUNDING * mean))
        alarms += int(np.count_nonzero(~(np.abs(difference) <= SIGMAS * error)))
        detectable.append(float((SIGMAS * error / mean).max()))
    values = {"alarms": float(alarms), "difference": float(abs(whole[0]) / whole[2])}
    return values | {"detectable": detectable[2], "detectable, each": detectable[1]}


STUDY = study(NAME, "Glass and its neighbours", __doc__, TERMS, cases)
