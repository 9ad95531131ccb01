"""The sentences of the first page: made from rows, and silent about nothing."""

import dataclasses
import math

import pytest

from mi_refract.report.first_page import STATES
from mi_refract.report.row import Row
from validation.directions import per_formula
from validation.efficiency import error_against_time
from validation.ground_truth import traced_bodies
from validation.renders import against_dielectric
from validation.run import headline
from validation.stability import layered_paths, optical_chains

WORST = {"worst rad": 5e-8, "worst / u": 0.9, "TIR misclassified": 0.0, "TIR misclassified, beyond its bound": 0.0}
OURS = Row(
    "directions",
    "promoted",
    "all regimes",
    "llvm float32",
    WORST,
    {"TIR misclassified, beyond its bound": 0.0},
    replay={"rays": 1000},
)
TEXTBOOK = dataclasses.replace(
    OURS, subject="cross", values={**WORST, "worst rad": math.pi / 2, "TIR misclassified": 70.0}
)
DOUBLE = dataclasses.replace(OURS, setting="llvm float64", values={**WORST, "worst rad": 1e-16})
RENDER = {"changed share": 0.01, "|mean ratio − 1|": 1e-6, "Welch alarms": 0.0, "time / dielectric": 1.1}
SPHERE = Row("renders", "refract", "sphere", "llvm_ad_rgb", RENDER, {"Welch alarms": 0.0})
MIRAGE = dataclasses.replace(SPHERE, case="mirage", values={**RENDER, "Welch alarms": 7.0}, budgets={})
ABSENT = Row("directions", "promoted", "all", "cuda float32", reason="no NVIDIA driver: libcuda.so.1 not found")
RENDERER = Row("per_ray", "PyGLM", "every set", "f32", reason="python -m validation renderers --install pyglm")


def test_the_names_are_those_of_the_studies():
    named = {
        per_formula: headline.DIRECTIONS,
        traced_bodies: headline.GROUND_TRUTH,
        against_dielectric: headline.RENDERS,
        error_against_time: headline.EFFICIENCY,
        layered_paths: headline.PATHS,
    }
    assert all(name == study.NAME for study, name in named.items())
    assert per_formula.ALL == headline.EVERYTHING and against_dielectric.TIME == headline.TIME
    known = {headline.COMMON, headline.WORST_IN_U, headline.MISCLASSIFIED, headline.MISCLASSIFIED_FAR}
    assert known <= per_formula.TERMS.keys()
    assert headline.EQUAL_TIME in error_against_time.TERMS and headline.WRONG_PATH in layered_paths.TERMS
    assert {headline.CHANGED_SHARE, headline.WELCH_ALARMS, headline.TIME} <= against_dielectric.TERMS.keys()
    assert headline.ERROR_OVER_BOUND in traced_bodies.TERMS and headline.SHALLOW in optical_chains.TERMS


def answers(*rows):
    return headline.first_page(rows)["answers"]


def test_a_run_of_nothing_says_so():
    page = headline.first_page([])
    assert [answer["state"] for answer in page["answers"]] == ["not measured"] * 4 + ["plain"]
    assert page["answers"][0]["text"] == "Not measured in this run."
    assert "image" not in page and "plot" not in page


def test_what_is_right_is_said_with_numbers():
    right, trusted, *_ = answers(OURS, DOUBLE, TEXTBOOK)
    assert right["state"] == trusted["state"] == "yes"
    for words in ("Yes.", "1,000 rays", "2.9\u00a0×\u00a010⁻⁶°", "no more than rounding"):
        assert words in right["text"], words
    for words in ("5.7\u00a0×\u00a010⁻¹⁵° in double", "90° (`cross`)", "7 % of these"):
        assert words in trusted["text"], words


@pytest.mark.parametrize(
    ("metric", "value", "words"), [("TIR misclassified, beyond its bound", 3.0, "on 3 of them"), ("worst / u", 2.0, "")]
)
def test_what_is_wrong_is_not_praised(metric, value, words):
    spoilt = dataclasses.replace(OURS, values={**WORST, metric: value}, budgets={metric: 1.0})
    right = answers(spoilt)[0]
    assert right["state"] == "no" and right["text"].startswith("No: a check failed.") and words in right["text"]
    assert metric != "worst / u" or "no more than rounding" not in right["text"]


def test_scenes_that_differ_are_named_with_what_is_right_there():
    traced = [
        Row("paths", name, "mirage: path", "llvm_ad_rgb", {"wrong path": lost}, replay={"rays": 64})
        for name, lost in (("refract", 0.0), ("dielectric", 11.0), ("exact, indices in float32", 7.0))
    ]
    text = answers(SPHERE, MIRAGE, *traced)[3]["text"]
    for words in ("1 of 2 scenes nowhere", "In `mirage`, 1.0 % of the pixels", "all 64 exact", "`dielectric` loses 11"):
        assert words in text, words
    assert "nowhere" not in answers(MIRAGE)[3]["text"]


def test_the_times_of_renders_and_of_equal_error():
    fast = Row("efficiency", "refract_path, split 3", "balls", "llvm_ad_rgb", {"equal-time MSE": 0.055})
    text = answers(SPHERE, fast)[2]["text"]
    assert "10 % slower" in text and "5.5 % (`balls`)" in text


def test_without_a_compiled_variant_only_double_precision_is_trusted_and_the_time_is_explained():
    scalar = dataclasses.replace(DOUBLE, setting="scalar float64")
    slow = dataclasses.replace(SPHERE, setting="scalar_rgb", values={**RENDER, "time / dielectric": 67.0})
    _, trusted, fast, *_ = answers(scalar, slow)
    assert "in double precision" in trusted["text"] and "single" not in trusted["text"]
    assert "67 times as long" in fast["text"] and "use a compiled one" in fast["text"] and "%" not in fast["text"]


def test_what_was_not_run_is_counted_by_what_would_bring_it():
    other = dataclasses.replace(ABSENT, reason="Dr.Jit cannot")
    text = answers(OURS, ABSENT, ABSENT, RENDERER, other)[4]["text"]
    assert text.startswith("4 of 5 measurements: 2 need an NVIDIA GPU")
    assert "1 need other renderers, by `python -m validation renderers --install pyglm`" in text
    assert "1 have other reasons" in text
    assert answers(OURS)[4]["text"] == "Everything was run."
    assert "`--profile standard` runs every study" in headline.first_page([OURS], "quick")["answers"][4]["text"]


def test_the_image_is_of_the_scene_that_differs_and_the_plot_of_methods_in_turn():
    images = {"reference": "a.exr", "test": "b.exr"}
    curves = {"refract": [(1.0, 1.0)], "dielectric": [(1.0, 1.0)]}
    rows = [dataclasses.replace(row, images=images, curves=curves) for row in (SPHERE, MIRAGE)]
    page = headline.first_page(rows)
    assert page["image"]["row"] == rows[1].name and page["plot"]["row"] == rows[0].name
    methods = Row(
        "efficiency",
        "every method",
        "balls",
        "llvm_ad_rgb",
        reason="",
        values={"x": 1.0},
        curves={"path + refract": [(1.0, 1.0)]},
    )
    assert headline.first_page([*rows, methods])["plot"]["labels"] == {"path + refract": "refract"}
    assert {answer["state"] for answer in page["answers"]} <= set(STATES)
