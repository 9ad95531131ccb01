"""The sentences of the first page: made from rows, and silent about nothing."""

import dataclasses
import math
import re

import pytest

from mi_refract.report.row import Reason, Row
from mi_refract.report.study_page import STATES
from validation.directions import per_formula, search, sweep
from validation.efficiency import error_against_time
from validation.ground_truth import traced_bodies
from validation.renders import against_dielectric
from validation.run import headline, metrics
from validation.stability import layered_paths, optical_chains
from validation.suite import matrix

WORST = {"worst rad": 5e-8, "worst / u": 0.9, "TIR misclassified": 0.0, "TIR misclassified, beyond its bound": 0.0}
DECIDED = {"TIR misclassified, beyond its bound": 0.0}
OURS = Row("directions", "promoted", "all regimes", "llvm float32", WORST, DECIDED, replay={"rays": 1000})
HARD = {**WORST, "worst rad": math.pi / 2, "TIR misclassified": 70.0}
TEXTBOOK = dataclasses.replace(OURS, subject="cross", values=HARD)
DOUBLE = dataclasses.replace(OURS, setting="llvm float64", values={**WORST, "worst rad": 1e-16})
RENDER = {"changed share": 0.01, "|mean ratio − 1|": 1e-6, "Welch alarms": 0.0, "time / dielectric": 1.1}
SPHERE = Row("renders", "refract", "sphere", "llvm_ad_rgb", RENDER, {"Welch alarms": 0.0})
MIRAGE = dataclasses.replace(SPHERE, case="mirage", values={**RENDER, "Welch alarms": 7.0}, budgets={})
SAME_SEEDS = {"changed share": 1.0, "|mean ratio − 1|": 0.5}
DARK = dataclasses.replace(SPHERE, case="furnace", values=SAME_SEEDS, budgets={"changed share": 1e-3})
FAST = [
    Row("efficiency", f"refract_path{split}", scene, "llvm_ad_rgb", {"equal-time MSE": value})
    for split, *values in (("", 0.7, 0.9, 1.1), (", split 1", 0.9, 0.8, 1.3), (", split 3", 0.055, 1.0, 1.2))
    for scene, value in zip(("balls", "nested", "slab"), values, strict=True)
]
# (seconds, RMSE) by samples per pixel; at fewer samples the splitting that turns out worse is better in `slab`.
CURVES = [
    Row("efficiency", "every method", scene, "llvm_ad_rgb", {"reference variance": 1e-6}, curves=curves)
    for scene, rmse in (("balls", 0.2), ("nested", 0.5), ("slab", 0.5))
    for curves in [{f"refract_path, split {n}": [(n, x), (9.0, 0.1)] for n, x in ((1, 0.4), (3, rmse))}]
]
ABSENT = Row("directions", "promoted", "all", "cuda float32", reason=Reason("no libcuda.so.1", "an NVIDIA GPU"))
INSTALL = "python -m validation renderers --install pyglm"
RENDERER = Row("per_ray", "PyGLM", "every set", "f32", reason=Reason(INSTALL, f"other renderers, by `{INSTALL}`"))
TRACED = [
    Row("paths", name, "mirage: path", "llvm_ad_rgb", {"wrong path": lost}, replay={"rays": 64})
    for name, lost in (("refract", 0.0), ("dielectric", 11.0), ("exact, indices in float32", 7.0))
]
LAYERS = [
    Row("stability", name, f"mirage askew, 1000 layers, {given}", "llvm float32", {"89.55°": error})
    for name, given, error in (("promoted", "contrasts", 1e-4), ("mi.fresnel + mi.refract", "indices", 0.5))
]


QUESTIONS = ("Is `refract` right?", "How far", "Is it as fast", "Where do the two differ", "What was not run")


def answers(*rows, profile=""):
    return headline.first_page(rows, profile)["answers"]


def answer_to(question, *rows, **how):
    (answer,) = (answer for answer in answers(*rows, **how) if answer["question"].startswith(QUESTIONS[question]))
    return answer


def test_the_names_are_those_of_the_studies():
    named = {per_formula: headline.DIRECTIONS, traced_bodies: headline.GROUND_TRUTH, layered_paths: headline.PATHS}
    named |= {against_dielectric: headline.RENDERS, error_against_time: headline.EFFICIENCY}
    assert all(name == study.NAME for study, name in named.items()) and per_formula.ALL == headline.EVERYTHING
    assert (per_formula.NAME, sweep.NAME, search.NAME) == headline.FORMULAS_IN and headline.SUMMARY == matrix.NAME
    known = {headline.COMMON, metrics.WORST_IN_U, metrics.MISCLASSIFIED, metrics.MISCLASSIFIED_FAR}
    assert known <= per_formula.TERMS.keys()
    assert metrics.EQUAL_TIME in error_against_time.TERMS
    assert {metrics.WRONG_PATH, metrics.OFF_EXACT, metrics.BUILTIN_OFF_EXACT} <= layered_paths.TERMS.keys()
    compared = {metrics.CHANGED_SHARE, metrics.WELCH_ALARMS, metrics.TIME_OVER_DIELECTRIC}
    assert compared <= against_dielectric.TERMS.keys()
    assert metrics.ERROR_OVER_BOUND in traced_bodies.TERMS and headline.SHALLOW in optical_chains.TERMS


SCALAR = dataclasses.replace(DOUBLE, setting="scalar float64")
SLOW = dataclasses.replace(SPHERE, setting="scalar_rgb", values={**RENDER, "time / dielectric": 67.0})
SOUND = dataclasses.replace(OURS, subject="compensated")
SPOILT = dataclasses.replace(OURS, values=WORST | {"TIR misclassified, beyond its bound": 3.0})
BODY = Row("ground_truth", "refract", "prism", "llvm_ad_rgb", {"error / bound": 0.5}, {"error / bound": 1.0})


@pytest.mark.parametrize(
    ("rows", "question", "state", "present", "absent"),
    [
        ([OURS, DOUBLE, TEXTBOOK], 0, "yes", ["Yes.", "1,000 rays", "2.9\u00a0×\u00a010⁻⁶°"], ["classified on"]),
        ([OURS, DOUBLE, TEXTBOOK], 1, "yes", ["5.7\u00a0×\u00a010⁻¹⁵° in double", "90° (`cross`)", "7 % of these"], []),
        ([SPOILT], 0, "no", ["No: a check failed.", "on 3 of them"], ["Yes"]),
        ([SPOILT], 1, "no", ["A check of `promoted` failed."], ["trusted"]),
        ([SPOILT, SOUND], 1, "no", ["A check of `promoted` failed. `compensated`, this"], ["`promoted`, "]),
        ([OURS, dataclasses.replace(SPOILT, study="sweep")], 0, "no", ["No: a check failed."], ["Yes"]),
        ([OURS, dataclasses.replace(SPOILT, study="sweep")], 1, "no", ["A check of `promoted`"], ["trusted"]),
        ([dataclasses.replace(OURS, values=WORST | {"worst / u": 2.0})], 0, "yes", ["Yes."], ["no more than rounding"]),
        ([BODY], 0, "yes", ["Yes.", "Through 1 bodies", "all its rays stay within"], ["direction"]),
        ([dataclasses.replace(BODY, values={"error / bound": 2.0})], 0, "no", ["No:", "some of its rays leave"], []),
        ([DARK], 0, "no", ["No: a check failed."], ["Yes"]),
        ([BODY, DARK], 0, "no", ["No: a check failed.", "all its rays stay within"], ["Yes"]),
        ([OURS, dataclasses.replace(SPOILT, study="media")], 1, "no", ["A check of `promoted`"], ["trusted"]),
        ([BODY, dataclasses.replace(BODY, values={"error / bound": math.nan})], 0, "no", ["of its rays leave"], []),
        ([SCALAR, SLOW], 1, "yes", ["in double precision"], ["single"]),
        ([SCALAR, SLOW], 2, "plain", ["67 times as long", "use a compiled variant"], ["%"]),
        ([SPHERE, *FAST], 2, "plain", ["10 % slower", "splitting is 0.70 to 1.10 of", "3 scenes: 0.90)"], []),
        ([SPHERE, *FAST, *CURVES], 2, "plain", ["samples is 0.06 to 1.30 of that of `path`", "3 scenes: 0.80)"], []),
        ([SPHERE, *FAST[:1]], 2, "plain", ["splitting is 0.70 of that of `path`."], ["`split_depth`"]),
        ([SPHERE, MIRAGE, *TRACED], 3, "yes", ["1 of 2 scenes they do not differ", "In `mirage`, 1.0 % of"], []),
        ([SPHERE, MIRAGE, *TRACED], 3, "yes", ["follows all 64 exact", "`dielectric` loses 11", "even exact"], []),
        ([SPHERE, DARK], 3, "no", ["1 of 2 scenes they do not differ", "In `furnace`, a check failed, and 100 %"], []),
        ([SPHERE, MIRAGE, DARK, *TRACED], 3, "no", ["In `mirage`, `refract` follows"], ["There"]),
        ([MIRAGE, *LAYERS], 3, "plain", ["In `mirage`", "0.010 %, Mitsuba's by 50 %"], ["do not differ"]),
        ([OURS], 4, "plain", ["Everything that was asked for was run."], []),
    ],
)  # fmt: skip
def test_what_is_said_and_what_is_not(rows, question, state, present, absent):
    answer = answer_to(question, *rows)
    assert answer["state"] == state, answer
    assert [words for words in present if words not in answer["text"]] == [], answer["text"]
    assert [words for words in absent if words in answer["text"]] == [], answer["text"]
    for text in (answer["text"] for answer in answers(*rows)):
        assert not re.search(r"[a-z][.,;:][A-Za-z]| [.,;:]|  ", text), text


def test_what_was_not_run_is_counted_by_what_would_make_it_run():
    page = headline.first_page([])
    assert "image" not in page and "plot" not in page
    everything, unmeasured = page["answers"]
    assert (everything["state"], unmeasured["state"]) == ("plain", "not measured")
    assert unmeasured["question"] == "Not measured in this run"
    assert all(question in unmeasured["text"] for question in QUESTIONS[:4])
    other = dataclasses.replace(ABSENT, reason="Dr.Jit cannot", remedy="")
    text = answer_to(4, OURS, ABSENT, ABSENT, RENDERER, other)["text"]
    assert text.startswith("4 of 5 measurements: 2 need an NVIDIA GPU")
    assert f"1 needs other renderers, by `{INSTALL}`;" in text and text.endswith("1 has other reasons.")
    repeated = [cell for cell in matrix.summary([RENDERER]) if cell.study == matrix.NAME]
    assert len(repeated) > 1 and {cell.remedy for cell in repeated} == {RENDERER.remedy}
    assert answer_to(4, OURS, RENDERER, *repeated)["text"].startswith("1 of 2 measurements")
    assert answer_to(4, OURS, ABSENT, ABSENT)["text"].startswith("2 of 3 measurements need an NVIDIA GPU")
    second = dataclasses.replace(RENDERER, remedy=RENDERER.remedy.replace("pyglm", "batoid"))
    both = "2 of 2 measurements need other renderers, by `python -m validation renderers --install batoid,pyglm`"
    assert both in answer_to(4, RENDERER, second)["text"]
    assert "`--profile standard` runs every study" in answer_to(4, OURS, profile="quick")["text"]


def test_the_image_is_of_the_scene_that_differs_and_the_plot_of_methods_in_turn():
    images = {"reference": "a.exr", "test": "b.exr"}
    curves = {"refract": [(1.0, 1.0)], "dielectric": [(1.0, 1.0)]}
    rows = [dataclasses.replace(row, images=images, curves=curves) for row in (SPHERE, MIRAGE)]
    page = headline.first_page(rows)
    assert page["image"]["row"] == rows[1].name and page["plot"]["row"] == rows[0].name
    drawn = {"path + refract": [(1.0, 1.0)]}
    methods = [dataclasses.replace(row, curves=row.curves | drawn) for row in CURVES]
    exact = {"off exact": 0.0033, "off exact, built-in": 0.018}
    seen = Row("paths", "refract", "mirage, telescope: image", "llvm_ad_rgb", exact, images=images | {"exact": "c.exr"})
    shown = headline.first_page([*rows, seen])["image"]
    assert shown["row"] == seen.name and shown["labels"]["exact"] == "exact paths"
    assert "1.8 % of the pixels of `dielectric` are wrong, 0.33 % of those of `refract`; its" in shown["caption"]
    wrong = dataclasses.replace(seen, budgets={"off exact": 1e-3})
    assert "0.33 % of those of `refract`." in headline.first_page([wrong])["image"]["caption"]
    dark = dataclasses.replace(DARK, images=images)
    assert headline.first_page([rows[0], dark])["image"]["caption"] == "Scene `furnace`: the two differ."
    assert headline.first_page(rows[:1])["image"]["caption"] == "Scene `sphere`: the same up to noise."
    plot = headline.first_page([*rows, *methods, *FAST])["plot"]
    labels = {"path + refract": "refract", "refract_path, split 3": "the same with split_depth 3"}
    assert plot["labels"] == labels and plot["row"] == methods[1].name  # of median gain
    assert {answer["state"] for answer in page["answers"]} <= set(STATES)
