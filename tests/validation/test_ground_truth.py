"""Benches and the rainbow: their answers without Mitsuba, their bounds, and planted defects that break every row."""

import functools
import math

import mitsuba as mi
import numpy as np
import pytest
from support.variants import switch

from validation import limits
from validation.ground_truth import bench, rainbow, traced_bodies
from validation.reference import closed_forms, optical_systems

DEFECT = 1e-4  # of an index
NAMES = [*bench.benches()]


@pytest.fixture(scope="module")
def made():
    """Every bench, with its bounds."""
    return bench.benches()


@pytest.fixture
def scalar(scalar_context):
    return scalar_context()


@pytest.mark.parametrize("name", NAMES)
def test_the_exact_path_has_the_closed_answer(name, made):
    case = made[name]
    for answer, x in case.deviations(case.system.path()).items():
        # Of the print, √3 and √2 times what it rounds to.
        assert x.max() <= case.system.printed.get(answer, 1e-15)


@pytest.mark.parametrize("name", NAMES)
def test_bounds_hold_whatever_is_rounded_and_are_not_idle(name, made):
    case, rng, ratios = made[name], np.random.default_rng(5), []
    system, sizes, exact = case.system, case.roundings(), case.system.off(case.system.path())
    for _ in range(30):
        # Each value off by all that it may, in a direction of its own.
        shifts = {key: size * optical_systems.unit(rng.normal(size=(len(size), 3))) for key, size in sizes.items()}
        off = system.off(system.path(moved=lambda j, what, x, axis, s=shifts: x + s.get((j, what), 0)))
        ratios += [
            optical_systems.dot(x - exact[answer], x - exact[answer])[..., 0] ** 0.5
            / (case.bounds[answer] - system.printed.get(answer, 0))
            for answer, x in off.items()
        ]
    worst = max(float(x.max()) for x in ratios)
    assert 0.1 < worst < 1


# By Mitsuba ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plugin", traced_bodies.PLUGINS)
@pytest.mark.parametrize("name", NAMES)
def test_both_plugins_keep_within_the_bounds(name, plugin, made, scalar):
    row = traced_bodies.bench_row(name, made[name], plugin, "scalar_rgb")
    assert row.verdict == ("pass" if plugin == "refract" else "info")
    assert row.values["error / bound"] < 0.2


@pytest.mark.parametrize("name", NAMES)
def test_an_index_off_by_1e_4_breaks_every_row(name, made, scalar, monkeypatch):
    def off(plugin, *indices):
        return glass(plugin, *(n + DEFECT * (n > 1) for n in indices))

    glass = bench.glass
    monkeypatch.setattr(bench, "glass", off)
    assert traced_bodies.bench_row(name, made[name], "refract", "scalar_rgb").broken == {"error / bound": 1.0}


@pytest.mark.parametrize("name", NAMES)
def test_normals_of_the_wrong_sign_break_every_row(name, made, scalar, monkeypatch):
    load = mi.load_dict

    def flipped(shape):
        nested = {key: flipped(x) if isinstance(x, dict) else x for key, x in shape.items()}
        return nested | ({"flip_normals": True} if shape["type"] in ("sphere", "cube", "ply", "rectangle") else {})

    monkeypatch.setattr(mi, "load_dict", lambda scene: load(flipped(scene)))
    assert traced_bodies.bench_row(name, made[name], "refract", "scalar_rgb").broken == {"error / bound": 1.0}


def test_a_bound_that_would_hold_whatever_comes_fails(scalar, monkeypatch):
    monkeypatch.setattr(bench, "PLACE", 100 * bench.PLACE)
    assert traced_bodies.bench_row("slab", bench.benches()["slab"], "refract", "scalar_rgb").broken == {
        "index seen": limits.INDEX_SEEN
    }


def test_compiled_rays_are_those_of_the_scalar_variant(made, needs_variant, scalar):
    """To roundings: a mistake in the order of rays or components would be of the size of the bodies."""
    needs_variant("llvm_ad_rgb")
    one = made["slab"].traced("refract")
    switch("llvm_ad_rgb")
    other = made["slab"].traced("refract")
    assert np.abs(one.places - other.places).max() < 1e-4
    assert np.abs(one.directions - other.directions).max() < 1e-5


# The rainbow ---------------------------------------------------------------------------------------------------


@functools.cache
def image(index):
    """Of the light once reflected within, without noise."""
    entry = np.linspace(0.79, 0.93, 1_000_000)
    radius = np.tan(np.pi - closed_forms.deflection(np.arcsin(entry), index, 1).astype(float))
    turn = 2 * np.pi * ((np.arange(len(entry)) * (math.sqrt(5) - 1) / 2) % 1)
    x, y = (((1 + radius * f(turn)) / 2 * rainbow.SIZE).astype(int) for f in (np.cos, np.sin))
    return np.bincount(x * rainbow.SIZE + y, entry, rainbow.SIZE**2).reshape(rainbow.SIZE, rainbow.SIZE)


def test_the_edge_of_a_bow_without_noise_is_the_rainbow_angle():
    assert rainbow.angle(4 / 3) == pytest.approx(180 - 42.03, abs=0.01)
    for index in (1.333, 1.338):
        assert abs(rainbow.edge(image(index)) - rainbow.angle(index)) < limits.RAINBOW_BLUR


def test_an_image_without_an_edge_has_none():
    assert math.isnan(rainbow.edge(np.zeros((rainbow.SIZE, rainbow.SIZE))))
    blank = [np.zeros((rainbow.SIZE, rainbow.SIZE))] * 3
    assert {"error / bound", "standard error / °"} == set(
        traced_bodies.bow_row("refract", "llvm_ad_rgb", blank, {}).broken
    )


@pytest.mark.parametrize("defect", [0.0, DEFECT])
def test_the_rainbow_of_a_noisy_bow_sees_an_index_off_by_1e_4(defect):
    """With as much light as the quick profile renders: 9000 quanta in the first 0.1 degrees of an image."""
    rng, exact = np.random.default_rng(11), image(1.333 + defect)
    ends, inside, at = rainbow._bins()
    light = np.bincount(at, exact[inside], len(ends))
    first = light[(ends > rainbow.angle()) & (ends < rainbow.angle() + 0.1)].sum()
    noisy = [rng.poisson(exact * 9e3 / first) for _ in range(traced_bodies.RENDERS["standard"])]
    row = traced_bodies.bow_row("refract", "llvm_ad_rgb", noisy, {})
    assert row.broken == ({"error / bound": 1.0} if defect else {})


def test_a_rendered_rainbow_stands_where_it_should_and_not_at_the_angle_of_another_index(llvm_variant, monkeypatch):
    """Four renders: with 3 degrees of freedom chance may take 22 standard errors."""
    monkeypatch.setattr(limits, "RAINBOW_RESOLVED", 0.005)
    found = rainbow.images(bench.glass("refract", rainbow.INDEX), 4)
    assert traced_bodies.bow_row("refract", "llvm_ad_rgb", found, {}).verdict == "pass"
    off = rainbow.angle(rainbow.INDEX - 1e-3)
    monkeypatch.setattr(rainbow, "angle", lambda: off)
    assert traced_bodies.bow_row("refract", "llvm_ad_rgb", found, {}).broken.keys() == {"error / bound"}
