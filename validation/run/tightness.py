"""Bounds far above the errors: where a budget is more than 100 times the largest error seen, the report says so.

A row per study: how many of its checks are that far from their bound, and for each subject and metric the largest share
of the bound that any case has used. Where some case comes near, the bound is that of the hardest case, and the others
are easy. Where none does, the row must say what the bound still excludes: `EXCLUDES`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from mi_refract.report.number_text import compact
from mi_refract.report.row import Row, by_study

NAME = "bounds"
LOOSE = 100.0  # a bound over the largest error
SHOWN = 12  # subjects and metrics that a row names, the loosest first
ABOUT = {
    "title": "Bounds and errors",
    "text": " ".join(__doc__.partition("\n")[2].replace("`EXCLUDES`", "the remark").split()),
    "terms": {
        "checks": "budgets that were measured and are not 0, of all rows of the study",
        "far from the bound": f"those of them with a bound more than {LOOSE:g} times the largest error",
        "share": "the part that they are",
        "loose in every case": "subjects and metrics of which no case comes nearer to its bound than that",
        "unexplained": "those of them of which nothing says what their bound still excludes",
    },
}
# By study and metric, for bounds that no case comes near: what they still exclude.
EXCLUDES = {
    (
        "energy",
        "inside: 1 − R / u",
    ): "roundings of thousands of nodes average out, and a worst case cannot count on it; "
    "12.5 u = 7.5e-7 excludes an index off by 1e-6",
    ("energy", "inside: R / u"): "as for 1 − R: an index off by 1e-6",
    ("energy", "outside: 1 − R / u"): "as for the inside: an index off by 1e-6",
    ("energy", "outside: R / u"): "as for the inside: an index off by 1e-6",
    ("paths", "pixels off, control"): "no lobe flipped; more than 1 pixel of 1000 would be another path",
    ("samples", "eta worst"): "equal to the last bit; an index off by 2e-7, an ulp of 1.5",
    ("samples", "lobe flips"): "none flipped; a density off by 1e-2 on a thousand rays",
    ("features", "off after an edit"): "equal to the last bit; an index off by 1e-5",
    ("planar", "difference"): "demanded, not derived: `error / bound` holds every path to less; a facet turned by 1e-9",
    ("planar_closed", "difference"): "demanded, not derived: `error / bound` holds every path to less",
    ("renders", "Welch alarms"): "no tile alarms; one of equal images would with probability 1e-3",
    ("self-test", "false alarms"): "no alarm among these pairs",
    ("self-test", "welch"): "no alarm: another sampler is no defect",
    ("welch_nulls", "alarms"): "no alarm among the pairs of a row; 1 of 8 fails, and 1 of 200 of all pairs",
    ("welch_nulls", "missed"): "none of the planted differences; 1 of 10 fails",
    ("visible_changes", "called different"): "none of these pairs; one of a hundred fails",
}


def rows(found: Iterable[Row]) -> list[Row]:
    """A row per study that has budgets other than 0."""
    made = []
    for study, members in by_study(found).items():
        shares = _shares(members)
        if shares:
            made.append(_row(study, shares))
    return made


def _shares(members: Iterable[Row]) -> dict[tuple[str, str], list[float]]:
    """By subject and metric, |value| over bound of every case and setting."""
    shares: dict[tuple[str, str], list[float]] = {}
    for row in members:
        for metric, bound in row.budgets.items() if row.values else ():
            value = row.values[metric]
            if bound > 0 and math.isfinite(value):
                shares.setdefault((row.subject, metric), []).append(value / bound)
    return shares


def _row(study: str, shares: dict[tuple[str, str], list[float]]) -> Row:
    checks = sum(map(len, shares.values()))
    far = {key: sum(LOOSE * x < 1 for x in each) for key, each in shares.items()}
    listed = sorted((key for key in shares if far[key]), key=lambda key: max(shares[key]))
    loose = [key for key in listed if far[key] == len(shares[key])]
    unexplained = [key for key in loose if (study, key[1]) not in EXCLUDES]
    values = {
        "checks": float(checks),
        "far from the bound": float(sum(far.values())),
        "share": sum(far.values()) / checks,
        "loose in every case": float(len(loose)),
        "unexplained": float(len(unexplained)),
    }
    said = [_said(study, *key, far[key], shares[key]) for key in listed]
    more = [f"and {len(said) - SHOWN} more subjects and metrics, listed in `replay`"] if len(said) > SHOWN else []
    replay = {"far from their bounds": said}
    case = f"more than {LOOSE:g} times the largest error"
    return Row(
        NAME, study, case, "", values, {"unexplained": 0.0}, reason="; ".join(said[:SHOWN] + more), replay=replay
    )


def _said(study: str, subject: str, metric: str, far: int, shares: list[float]) -> str:
    """ "subject, metric: 3 of 12 rows, elsewhere up to 0.8 of the bound", or what the bound excludes."""
    text = f"{subject}, {metric}: {far} of {len(shares)} rows"
    if far < len(shares):
        return f"{text}, others use up to {compact(max(shares), 2)} of it"
    return f"{text}; excludes: {EXCLUDES.get((study, metric), 'not said')}"
