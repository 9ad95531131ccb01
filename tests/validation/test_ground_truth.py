"""Benches and the rainbow: their answers without Mitsuba, their bounds, and planted defects that break every row."""

import functools
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refract import FORMULAS
from validation import limits
from validation.ground_truth import bench, rainbow, traced_bodies
from validation.reference import closed_forms, optical_systems

DEFECT = 1e-4  # of an index
BENCHES = bench.benches()


def bench_row(name, plugin="refract"):
    return traced_bodies.bench_row(name, BENCHES[name], plugin, "scalar_rgb")


@pytest.mark.parametrize("name", BENCHES)
def test_the_exact_path_has_the_closed_answer_and_bounds_are_not_idle(name):
    """Of the print, √3 and √2 times what it rounds to. Each value off by all that it may, in a direction of its own."""
    case, rng, ratios = BENCHES[name], np.random.default_rng(5), []
    system, sizes = case.system, case.roundings()
    for answer, x in case.deviations(system.path()).items():
        assert x.max() <= system.printed.get(answer, 1e-15)
    exact = system.off(system.path())
    for _ in range(30):
        shifts = {key: size * optical_systems.unit(rng.normal(size=(len(size), 3))) for key, size in sizes.items()}
        off = system.off(system.path(moved=lambda j, what, x, axis, s=shifts: x + s.get((j, what), 0)))
        bounds = {answer: case.bounds[answer] - system.printed.get(answer, 0) for answer in off}
        ratios += [optical_systems.length(x - exact[answer])[..., 0] / bounds[answer] for answer, x in off.items()]
    assert 0.1 < max(float(x.max()) for x in ratios) < 1


@pytest.mark.parametrize("name", BENCHES)
def test_rows_hold_and_a_wrong_index_and_flipped_normals_break_each(name, scalar_context, monkeypatch):
    for plugin, verdict in zip(traced_bodies.PLUGINS, ("pass", "info"), strict=True):
        row = bench_row(name, plugin)
        assert row.verdict == verdict and row.values["error / bound"] < 0.2
    glass, load = bench.glass, mi.load_dict

    def flipped(shape):
        nested = {key: flipped(x) if isinstance(x, dict) else x for key, x in shape.items()}
        return nested | ({"flip_normals": True} if shape["type"] in ("sphere", "cube", "ply", "rectangle") else {})

    with monkeypatch.context() as patch:
        patch.setattr(bench, "glass", lambda plugin, *indices: glass(plugin, *(n + DEFECT * (n > 1) for n in indices)))
        assert bench_row(name).broken == {"error / bound": 1.0}
    monkeypatch.setattr(mi, "load_dict", lambda scene: load(flipped(scene)))
    assert bench_row(name).broken == {"error / bound": 1.0}


def test_a_bound_that_would_hold_whatever_comes_fails(scalar_context, monkeypatch):
    slab = BENCHES["slab"]
    monkeypatch.setitem(vars(slab), "bounds", {name: 100 * x for name, x in slab.bounds.items()})
    assert bench_row("slab").broken == {"index seen": limits.INDEX_SEEN}


# The double Gauss, traced exactly by CODE V --------------------------------------------------------------------


@pytest.mark.parametrize("name", FORMULAS)
def test_every_formula_retraces_the_lens_within_the_print(name):
    """On scalar arrays in float64, ray by ray."""

    def by_rows(a, n, k):
        rows = zip(a.astype(float), n.astype(float), strict=True)
        refracted = [FORMULAS[name](dr.scalar.Array3f64(x), dr.scalar.Array3f64(y), float(k)) for x, y in rows]
        assert all(transmitted for _, transmitted in refracted)
        return optical_systems.vectors(*zip(*(list(b) for b, _ in refracted), strict=True))

    assert optical_systems.off_print(by_rows) <= 1


def test_a_prescription_off_in_the_fifth_digit_is_seen():
    path = optical_systems.double_gauss().path()
    assert path.places.shape == path.directions.shape == (11, 9, 3)  # nine rays through eleven surfaces
    for column in range(3):
        wrong = [list(surface) for surface in optical_systems.double_gauss_data()["prescription"]]
        wrong[2][column] *= 1 + 1e-5
        assert optical_systems.off_print(optical_systems.snell, wrong) > 1


# The rainbow ---------------------------------------------------------------------------------------------------


@functools.cache
def image(index):
    """Of the light once reflected within, without noise."""
    entry = np.linspace(0.79, 0.93, 1_000_000)
    radius = np.tan(np.pi - closed_forms.deflection(np.arcsin(entry), index, 1).astype(float))
    turn = 2 * np.pi * ((np.arange(len(entry)) * (math.sqrt(5) - 1) / 2) % 1)
    x, y = (((1 + radius * f(turn)) / 2 * rainbow.SIZE).astype(int) for f in (np.cos, np.sin))
    return np.bincount(x * rainbow.SIZE + y, entry, rainbow.SIZE**2).reshape(rainbow.SIZE, rainbow.SIZE)


def bow_row(images):
    return traced_bodies.bow_row("refract", "llvm_ad_rgb", images, {})


def test_the_edge_of_a_bow_without_noise_is_the_rainbow_angle_and_a_blank_image_has_none():
    assert rainbow.angle(4 / 3) == pytest.approx(180 - 42.03, abs=0.01)
    for index in (1.333, 1.338):
        assert abs(rainbow.edge(image(index)) - rainbow.angle(index)) < limits.RAINBOW_BLUR
    blank = np.zeros((rainbow.SIZE, rainbow.SIZE))
    assert math.isnan(rainbow.edge(blank))
    assert bow_row([blank] * 3).broken.keys() == {"error / bound", "standard error / °"}


@pytest.mark.parametrize("defect", [0.0, DEFECT])
def test_the_rainbow_of_a_noisy_bow_sees_an_index_off_by_1e_4(defect):
    """With as much light as the quick profile renders: 9000 quanta in the first 0.1 degrees of an image."""
    rng, exact = np.random.default_rng(11), image(1.333 + defect)
    x = (np.arange(rainbow.SIZE) + 0.5) / (rainbow.SIZE / 2) - 1
    beyond = 180 - np.rad2deg(np.arctan(np.hypot(x[:, None], x))) - rainbow.angle()
    first = exact[(beyond > 0) & (beyond < 0.1)].sum()
    noisy = [rng.poisson(exact * 9e3 / first) for _ in range(traced_bodies.RENDERS["standard"])]
    assert bow_row(noisy).broken == ({"error / bound": 1.0} if defect else {})
