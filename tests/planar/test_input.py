"""Bad input of the planar system: each kind is named in one line; what is no bad input is taken."""

import math

import numpy as np
import pytest
from support.planar_scenes import SQUARE, polygon, story, together

from mi_refract.backend import Backend
from mi_refract.planar import Event, Segments, array_backend, trace

NO_LLVM = "; llvm cannot run here: why"
GOOD = {"start": [(0.0, 0.0)], "end": [(1.0, 0.0)], "n_left": [1.5], "n_right": [1.0]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_left": [0.0]}, "n_left[0] = 0.0; expected more than 0"),
        ({"n_right": [math.nan]}, "n_right[0] = nan; expected finite"),
        ({"end": [(1.0, math.inf)]}, "end[0, 1] = inf; expected finite"),
        ({"end": [(1.0, 0.0), (2.0, 0.0)]}, "end: shape (2, 2); expected (1, 2)"),
        ({"start": "here"}, "start: expected numbers"),
        ({"start": [], "end": [], "n_left": [], "n_right": []}, "none; expected at least one"),
        ({"control": [(0.0, 1.0)]}, "control and weight; expected both or neither"),
        ({"control": [(0.0, 1.0)], "weight": [-1.0]}, "weight[0] = -1.0; expected more than 0"),
    ],
)
def test_bad_segments_are_named_in_one_line(change, message):
    with pytest.raises(ValueError) as error:
        Segments(**(GOOD | change))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_segments_that_coincide_are_refused():
    twice = {"start": [(0, 0), (1, 0)], "end": [(1, 0), (0, 0)], "n_left": [1.5, 1.5], "n_right": [1, 1]}
    with pytest.raises(ValueError, match="segments 0 and 1 coincide"):
        Segments(**twice)
    for control, weight in (([(0.5, 0.5), (0.5, -0.5)], [0.9, 0.9]), ([(0.5, 0.5)] * 2, [0.8, 0.9])):
        assert len(Segments(**twice, control=control, weight=weight)) == 2
    with pytest.raises(ValueError, match="segments 0 and 1 coincide"):
        Segments(**twice, control=[(0.0, 0.5), (-0.0, 0.5)], weight=[0.9, 0.9])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_depth": 0}, "max_depth = 0; expected a whole number, 1 or more"),
        ({"max_depth": 2.5}, "max_depth = 2.5; expected"),
        ({"origins": [(0.0, math.nan)]}, "origins[0, 1] = nan; expected finite"),
        ({"directions": [(0.0, 0.0)]}, "directions[0] = (0, 0); expected a direction"),
        ({"directions": [(0.0, 1.0)] * 2}, "directions: shape (2, 2); expected (1, 2)"),
        ({"formula": "sellmeier"}, "formula = 'sellmeier': unknown; expected wedge"),
        ({"precision": "float16"}, "precision = 'float16'; expected float32, float64"),
        ({"backend": "metal"}, "backend = 'metal'; expected scalar, llvm, cuda"),
        ({"method": "bvh"}, "method = 'bvh'; expected auto, brute, mesh"),
        ({"reflect": -1}, "reflect; expected a whole number"),
        ({"reflect": 0.5}, "reflect; expected a whole number"),
        ({"reflect": 2**32}, "reflect; expected a whole number, 0 or more and below 2³²"),
        ({"max_depth": True}, "max_depth = True; expected a whole number, 1 or more"),
        ({"n_start": math.inf}, "n_start; expected a number"),
        ({"n_start": "air"}, "n_start; expected a number"),
        ({"n_start": 0}, "n_start; expected a number"),
        ({"origins": [(0.0, 1e101)]}, "origins: a number beyond ±1e+100"),
        ({"max_depth": 2**32}, "1 rays, max_depth = 4294967296; expected a product below 2³²"),
        ({"n_start": math.nan}, "n_start; expected a number"),
    ],
)
def test_bad_arguments_are_named_in_one_line(change, message):
    arguments = {"origins": [(0.5, 1.0)], "directions": [(0.0, -1.0)], "max_depth": 2} | change
    with pytest.raises(ValueError) as error:
        trace(Segments(**GOOD), **arguments)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_float32_has_a_range_of_its_own(needs_variant):
    needs_variant("llvm_ad_rgb")
    with pytest.raises(ValueError, match=r"origins: a number beyond ±1e\+15"):
        trace(Segments(**GOOD), [(0.0, -1e16)], [(0.0, 1.0)], 2, precision="float32", backend="llvm")


@pytest.mark.parametrize(
    ("asked", "llvm", "end"),
    [
        ("scalar", True, ""),
        ("scalar", False, "; llvm cannot run here: why"),
        (None, False, "; llvm cannot run here: why"),
    ],
)
def test_scalar_arrays_refuse_float32_because_they_compute_in_double(monkeypatch, asked, llvm, end):
    """Asked for by name, or chosen because LLVM cannot run here."""
    usable = {"scalar": True, "llvm": llvm, "cuda": False}
    monkeypatch.setattr(array_backend, "detect", lambda: {name: Backend(name, u, "why") for name, u in usable.items()})
    with pytest.raises(ValueError) as error:
        array_backend.choose_backend(asked, "float32")
    message = "precision = 'float32': scalar arrays compute in double; expected float64, or a compiled backend (llvm, "
    assert str(error.value) == f"{message}cuda){end}"
    assert array_backend.choose_backend("scalar", "float64").number is float


@pytest.mark.parametrize("length", [1e-300, 1e-30, 1e30, 1e300])
def test_a_direction_may_have_any_length(follow, length):
    square = polygon(SQUARE)
    assert story(follow(square, (-1, 0.5), (length, 0.1 * length))) == story(follow(square, (-1, 0.5), (1, 0.1)))


def test_a_scene_may_be_small(follow, setting):
    size = 1e-15 if setting.name == "float32" else 1e-60
    triangle, origin = np.array([(0, 0), (1, 0), (0.3, 1)]), np.array([-1, 0.1])
    plain, small = (follow(polygon(triangle * s), origin * s, (1, 0.17)) for s in (1, size))
    assert story(small) == story(plain)
    assert small.points[0, :3] / size == pytest.approx(plain.points[0, :3], abs=16 * setting.roundoff)


def test_a_scene_far_from_0_keeps_its_digits(follow, setting):
    """Where float32 has steps of 0.125: differences of coordinates are exact, and only they count."""
    triangle, origin = np.array([(0, 0), (1, 0), (0.25, 1)]), np.array([-1, 0.125])
    plain, far = (follow(polygon(triangle + x), origin + x, (1, 0.17)) for x in (0.0, 2.0**20))
    assert story(far) == story(plain)
    assert far.directions == pytest.approx(plain.directions, abs=16 * setting.roundoff)


@pytest.mark.parametrize("method", ["auto", "brute", "mesh"])
def test_nothing_but_segments_of_length_zero_is_no_boundary_either(follow, method):
    dots = together(*[polygon([(0.5, 0.5)])] * 60)
    assert story(follow(dots, (0, 0), (1, 1), method=method)) == ([], [Event.ESCAPED])


def test_no_rays_are_no_paths(follow):
    paths = follow(polygon(SQUARE), np.zeros((0, 2)), np.zeros((0, 2)), max_depth=3)
    assert paths.points.shape == (0, 4, 2)
