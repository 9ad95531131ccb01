"""The layers of the mirage and of the fibre, the exact paths through them, and what the study of both can see."""

import dataclasses
import math

import mitsuba as mi
import numpy as np
import pytest

from mi_refract import backend
from validation.reference import layered_scenes
from validation.reference.layered_scenes import FIBRE, LAYERS, MIRAGE, exact_path
from validation.run import path_overlay
from validation.run.context import PROFILES, SCENES, Context
from validation.stability import layered_paths

each = pytest.mark.parametrize("layers", LAYERS.values(), ids=LAYERS)


@pytest.fixture
def context(tmp_path):
    profile = dataclasses.replace(PROFILES["standard"], resolution=48, spp=4)
    return Context(profile, tmp_path, "llvm_ad_rgb", backend.detect(), {})


# Layers --------------------------------------------------------------------------------------------------------


@each
def test_a_scene_holds_the_layers_that_are_computed(layers):
    text = (SCENES / f"{layers.scene}.xml").read_text()
    assert layered_scenes.block(layers).strip("\n") == text.partition("layers -->\n")[2].partition("\n<!-- end")[0]


def skipped(layers, where):
    """Boundaries that lie nearer to the next than Mitsuba's ray offset at a distance of `where` from the origin."""
    return (-np.diff(layers.boundaries) <= layered_scenes.OFFSET * (1 + where)).sum()


def test_no_layer_is_thinner_than_the_ray_offset():
    assert skipped(MIRAGE, layered_scenes.POOL) == 0
    assert skipped(FIBRE, abs(FIBRE.end)) == 0
    halved = dataclasses.replace(MIRAGE, boundaries=tuple(np.array(MIRAGE.boundaries) / 2))
    assert skipped(halved, layered_scenes.POOL) == len(MIRAGE.boundaries) - 1


# Exact paths ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sine", [4e-4, 8e-4, 3e-3, 9e-3])
@pytest.mark.parametrize("offset", [layered_scenes.OFFSET, 0.0])
def test_a_mirage_conserves_n_sin_and_turns_where_that_is_the_index(sine, offset):
    path = exact_path(MIRAGE, [-layered_scenes.POOL, 0.005, 0], [math.sqrt(1 - sine**2), -sine, 0], 0, offset)
    n = np.array(MIRAGE.indices)[list(path.media)]
    assert n * path.directions[:, 0] == pytest.approx(path.directions[0, 0] * MIRAGE.indices[0], rel=1e-15)
    deepest = max(path.media)
    assert MIRAGE.indices[deepest + 1] < MIRAGE.indices[0] * math.sqrt(1 - sine**2) < MIRAGE.indices[deepest]
    # Down to the boundary that reflects it, no farther, and out as it came in.
    assert path.ends[:, 1].min() == pytest.approx(MIRAGE.boundaries[deepest], abs=1e-12)
    assert path.directions[-1, 1] == pytest.approx(sine, rel=1e-12)
    assert path.starts[1:, 1] - path.ends[:-1, 1] == pytest.approx(
        np.sign(path.directions[1:, 1]) * offset * (1 + np.abs(path.ends[:-1]).max(1)), abs=1e-15
    )


def test_a_fibre_conserves_both_invariants_and_keeps_what_it_guides():
    rays = layered_paths.bundle(FIBRE)
    for path in rays.exact(FIBRE, offset=0.0):
        n = np.array(FIBRE.indices)[list(path.media)]
        assert np.ptp(n * path.directions[:, 2]) < 1e-14
        assert np.ptp(n * np.cross(path.starts, path.directions)[:, 2]) < 1e-12
        radius = np.hypot(*path.ends[:-1, :2].T)
        assert min(abs(radius[:, None] - FIBRE.boundaries).min(1), default=0) < 1e-12
        assert path.ends[-1, 2] == pytest.approx(FIBRE.end)
        assert min(path.media) >= 1


def test_a_deviation_is_the_one_that_was_put_in():
    """A path at an angle that is 1 % too large, in the layer that both are in."""
    right, wrong = (
        exact_path(MIRAGE, [-layered_scenes.POOL, 1.0, 0], [math.sqrt(1 - c * c), -c, 0], 0) for c in (8e-4, 8.08e-4)
    )
    found = layered_paths.deviation(MIRAGE, right, wrong.segments())
    assert found.direction[0] == pytest.approx(0.01, rel=1e-3)
    assert found.boundaries == 0
    same = layered_paths.deviation(MIRAGE, right, right.segments())
    assert same.direction.max() < 1e-12 and same.place.max() < 1e-12


# The study -----------------------------------------------------------------------------------------------------


def test_every_plugin_is_traced_and_only_forms_at_the_rounding_limit_keep_to_the_path(llvm_variant, context):
    rows = {row.subject: row for row in layered_paths.path_rows(context, MIRAGE) if row.case == "mirage: path"}
    assert list(rows) == [*layered_paths.plugins(), layered_paths.INDICES, layered_paths.RATIOS]
    held = rows["refract"]
    assert held.verdict == rows["refract_compensated"].verdict == rows["refract_promoted"].verdict == "pass"
    assert {name: row.verdict for name, row in rows.items() if not row.budgets} == dict.fromkeys(
        (name for name in rows if name not in ("refract", "refract_compensated", "refract_promoted")), "info"
    )
    # What has no budget would break it: the check can fail.
    for name, row in rows.items():
        if not row.budgets:
            assert dataclasses.replace(row, budgets=held.budgets).broken.keys() == held.budgets.keys(), name


def test_a_fibre_guides_every_ray_with_every_plugin(llvm_variant, context):
    rows = [row for row in layered_paths.path_rows(context, FIBRE) if row.case == "fibre: path"]
    assert {row.values["wrong path"] for row in rows} == {0.0}
    assert all(row.values["direction"] < 0.01 for row in rows)


def test_a_path_is_not_run_on_scalar_arrays(context):
    scalar = dataclasses.replace(context, variant="scalar_rgb")
    rows = [row for task in layered_paths.tasks(scalar) for row in task.run()]
    assert {row.verdict for row in rows} == {"not run"}
    assert {row.case for row in rows} >= {"mirage", "fibre", "mirage, telescope: image"}


def test_the_built_in_differs_from_both_right_formulas_in_the_telescope(llvm_variant, context, monkeypatch):
    """Why `renders` demands nothing of this scene's agreement; and two of which one is not right are seen."""
    view, views = layered_paths.View, {}
    once = lambda *asked: views.get(asked[1]) or views.setdefault(asked[1], view(*asked))  # noqa: E731
    monkeypatch.setattr(layered_paths, "View", once)
    (row,) = layered_paths.view_rows(context, *layered_paths.VIEWS[0])
    assert row.values["pixels off"] > 5e-3
    assert row.verdict == "pass"
    assert all((context.out / path).is_file() for path in row.images.values())
    monkeypatch.setattr(layered_paths, "other_right_formula", lambda: "refract_decomposed")
    (row,) = layered_paths.view_rows(context, *layered_paths.VIEWS[0])
    assert row.broken.keys() == {"pixels off, control"}


@each
def test_points_are_projected_as_the_camera_sees_them(layers, scalar_variant):
    view = path_overlay.View(layers.scene, "dielectric", {}, 4, 1)
    for u, v in ((0.1, 0.2), (0.7, 0.4)):
        ray, _ = view.scene.sensors()[0].sample_ray(0, 0.5, mi.Point2f(u, v), mi.Point2f(0.5))
        for p, d in ((np.array(ray.o), np.array(ray.d)), view.ray(u, v)):
            assert view.project((p + 500 * d)[None])[0] == pytest.approx([u, v], abs=1e-4)
