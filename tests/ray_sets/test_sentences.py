"""What a check says in one line, for every kind of result."""

import math
from dataclasses import replace

import pytest

from mi_refract.ray_sets import reports
from mi_refract.ray_sets.check_answers import Findings, Problem, RegimeErrors
from mi_refract.ray_sets.diagnosis import Explanation
from mi_refract.ray_sets.tir_signal import NONE, UNCLEAR

ERRORS = ("p99", "mean", "length_error", "error_over_bound", "backward_median", "backward_p99", "backward_worst")
MISSING = Problem("missing", 3, "ids 1, 5, 8")
CERTAIN = Explanation("eta inverted", "k was n_to / n_from", 0.97, 1e-3, True)
LIKELY, NEVER = (Explanation("handedness", f"text {share}", share, math.nan, False) for share in (0.25, 0.0))


def regime(name="generic", worst=2e-7, **changes):
    counts = {"rays": 10, "compared": 9, "judged": 9, "wrong": 0, "right": 8, "exact": 4, "undecidable": 0}
    zero = dict.fromkeys(ERRORS, 0.0)
    return RegimeErrors(
        name, worst=worst, **zero, **counts | changes, tir_misclassified=0, tir_beyond_bound=0, replay={}
    )


def found(*regimes, problems=(), explanations=(), tir="zero", tir_given=False):
    return Findings("f32", 2.0**-23, "decomposed", tir, tir_given, regimes, problems, explanations, {})


LARGEST = "the largest error is 3e-7 rad (critical)"
OTHERS = "the others are within the error bound of the formula decomposed"
SOME_RIGHT = f"of 20 answers are right, {OTHERS}; {LARGEST}"
TWO = regime(), regime("critical", 3e-7)


@pytest.mark.parametrize(
    ("result", "code", "said"),
    [
        (found(), 2, "no ray was answered"),
        (found(*TWO), 0, f"16 {SOME_RIGHT}"),
        (found(*TWO, regime("k", math.nan, rays=0, compared=0, judged=0, right=0)), 0, f"16 {SOME_RIGHT}"),
        (found(*(replace(x, right=10) for x in TWO)), 0, f"20 answers, all right; {LARGEST}"),
        (
            found(regime(undecidable=2), TWO[1]),
            0,
            f"16 {SOME_RIGHT}; 2 rays are undecidable (error bound above 0.1 rad)",
        ),
        (found(regime(exact=10)), 0, "10 answers, all exact up to rounding"),
        (found(regime(wrong=2)), 1, "2 of 10 answers are wrong"),
        (found(regime(), tir=UNCLEAR), 1, "0 of 10 answers are wrong"),
        (found(regime(wrong=2), explanations=(LIKELY, CERTAIN)), 1, "2 of 10 answers are wrong: eta inverted"),
        (found(regime(wrong=2), explanations=(CERTAIN, CERTAIN)), 1, "2 of 10 answers are wrong"),
        (found(regime(), problems=(MISSING,)), 2, "10 answers, but they do not match the rays"),
        (
            found(regime(wrong=2), problems=(MISSING,)),
            2,
            "10 answers, but they do not match the rays; 2 of them are wrong",
        ),
        (found(regime(judged=0)), 1, "10 answers, none of them a direction that shows anything"),
        (found(regime(compared=0, judged=0)), 1, "10 answers, none of them a direction"),
    ],
)
def test_the_sentence(result, code, said):
    assert (result.exit_code, reports.sentence(result)) == (code, said)


def test_a_problem_and_a_signal_in_one_line():
    assert reports.problem_text(MISSING) == "3 without an answer: ids 1, 5, 8"
    signals = {
        (tir, given): reports.signal(found(tir=tir, tir_given=given))
        for tir in ("zero", NONE, UNCLEAR)
        for given in (False, True)
    }
    detected = [key for key, text in signals.items() if text.endswith(" (detected)")]
    assert detected == [("zero", False)]
    assert signals["zero", True] == reports.SIGNALS["zero"]


NONE_OF_THEM = "none of the usual mistakes explains the answers"


@pytest.mark.parametrize(
    ("result", "lines"),
    [
        (found(regime()), []),
        (
            found(regime(wrong=1), explanations=(NEVER, CERTAIN)),
            ["eta inverted: k was n_to / n_from (97.0% of the answers on which it has an effect)"],
        ),
        (
            found(regime(wrong=1), explanations=(NEVER, LIKELY)),
            [NONE_OF_THEM, "handedness: text 0.25 (25.0% of the answers on which it has an effect)"],
        ),
        (found(regime(wrong=1), explanations=(NEVER,)), [NONE_OF_THEM]),
        (found(regime(wrong=1), explanations=(LIKELY,), problems=(MISSING,)), []),
        (found(regime(wrong=1), explanations=(CERTAIN,), problems=(MISSING,)), [reports._line(CERTAIN)]),
    ],
)
def test_the_explanations(result, lines):
    assert reports.explained(result) == lines


@pytest.mark.parametrize(
    ("changes", "grade"),
    [
        ({}, "within bound"),
        ({"right": 10}, "right"),
        ({"right": 10, "exact": 10}, "exact"),
        ({"wrong": 1, "exact": 10, "right": 10}, "wrong"),
    ],
)
def test_a_grade(changes, grade):
    assert reports.grade(regime(**changes)) == grade
