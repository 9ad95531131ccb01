"""Bounds far above the errors: budgets that are more than 100 times the largest measured error.

There is a row per study: the number of checks that are so far from their bound, and for each subject and metric the
largest share of the bound that any case uses. If one case comes near, the bound is that of the hardest case. If no case
does, the row must state what the bound still excludes: `EXCLUDES`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from mi_refract.formulas import FORMULAS
from mi_refract.io.text import compact
from mi_refract.plugins import PLUGIN
from mi_refract.report.row import Row, by_study

from .metrics import CHANGED_SHARE

NAME = "bounds"
LOOSE = 100.0  # a bound is loose if it exceeds the largest error by this factor
SHOWN = 12  # number of subjects and metrics in a row's remark, the loosest first
ABOUT = {
    "title": "Bounds and errors",
    "text": " ".join(__doc__.partition("\n")[2].replace("`EXCLUDES`", "the remark").split()),
    "terms": {
        "checks": "measured budgets other than 0, in all rows of the study",
        "far from the bound": f"checks with a bound more than {LOOSE:g} times the error",
        "share": "share of these checks",
        "loose in every case": "subjects and metrics in which no case comes nearer to its bound",
        "unexplained": "loose subjects and metrics without a statement of what their bound still excludes",
    },
}
PLUGINS = (PLUGIN, *(f"{PLUGIN}_{name}" for name in FORMULAS))
DIFFUSE = "roundings of thousands of nodes average out; 12.5 u = 7.5e-7 excludes an index off by 1e-6"
PAIRS = (
    *("every form", "variances", "variance of the reference", "variance of the new image", "reference", "new image"),
    *("passes", "passes, filter of 0.5", "passes, filter of 3", "passes of one, filter of 1"),
    *("renders", "renders, filter of 2", "renders, a tile denoised", "renders without samples"),
)
NULL_PAIRS = "null pairs, exact", "null pairs, tolerance", "null pairs, paired", "null pairs, flip"
UNSEEN = (
    *("last bits", "one code", "dithering", "other antialiasing", "less antialiasing"),
    *("a quarter pixel", "half a pixel", "JPEG", "noise", "half floats"),
)
# By study and metric, for bounds that no case comes near: the subjects, and what the bound excludes.
EXCLUDES: dict[tuple[str, str], tuple[tuple[str, ...], str]] = {
    **{("energy", f"{at}: {x} / u"): (("powers",), DIFFUSE) for at in ("inside", "outside") for x in ("R", "1 − R")},
    ("paths", "pixels off, control"): (("refract",), "no lobe flipped; more than 1 pixel of 1000 is another path"),
    ("samples", "eta worst"): (("refract − dielectric",), "equal to the last bit; an index off by 2e-7, an ulp of 1.5"),
    ("samples", "lobe flips"): (("refract − dielectric",), "none flipped; a density off by 1e-2 on a thousand rays"),
    ("renders", CHANGED_SHARE): (PLUGINS, "a few pixels with another lobe; more than 1 pixel of 1000 is another path"),
    ("thin panes", "mean radiance off"): (("refract_path",), "no ray lost in the glass; more than one of 1000"),
    ("features", "off after an edit"): (("refract",), "equal to the last bit; an index off by 1e-5"),
    ("gradients", "forward"): (("refract_path",), "the same seeds: a mode off by a twentieth of the standard error"),
    ("passes", "beyond"): (("--until",), "none; the claim of 5 %: 6 of 20, 14 of 100. Half of them end far below it"),
    ("planar", "difference"): (("trace",), "`error / bound` holds every path to less; a facet turned by 1e-9"),
    ("planar_closed", "difference"): (("trace",), "`error / bound` holds every path to less"),
    ("self-test", "false alarms"): (NULL_PAIRS, "no alarm among these pairs"),
    ("self-test", "welch"): (("other sampler",), "no alarm: another sampler is no defect"),
    ("welch_nulls", "alarms"): (PAIRS, "no alarm among the pairs of a row; 1 of 8 fails, and 1 of 200 of all pairs"),
    ("welch_nulls", "missed"): (PAIRS, "none of the planted differences; 1 of 10 fails"),
    ("code mutants", "unexplained"): (("all rooms",), "none unexplained; more than 1 of 20 fails"),
    ("visible_changes", "called different"): (UNSEEN, "none of these pairs; one of a hundred fails"),
}


def excluded(study: str, subject: str, metric: str) -> str:
    """Return what a bound far above the errors still excludes; "" if that is not stated."""
    subjects, text = EXCLUDES.get((study, metric), ((), ""))
    return text if subject in subjects else ""


def rows(measured: Iterable[Row]) -> list[Row]:
    """Return a row per study that has budgets other than 0."""
    result = []
    for study, members in by_study(measured).items():
        shares: dict[tuple[str, str], list[float]] = {}  # by subject and metric: value over bound of every case
        for row in members:
            for metric, bound in row.budgets.items() if row.values else ():
                if bound > 0 and math.isfinite(row.values[metric]):
                    shares.setdefault((row.subject, metric), []).append(row.values[metric] / bound)
        checks = sum(map(len, shares.values()))
        counts = {key: sum(LOOSE * x < 1 for x in used) for key, used in shares.items()}
        far = {key: count for key, count in counts.items() if count}
        loose = {key for key, count in far.items() if count == len(shares[key])}
        remarks = []
        for key in sorted(far, key=lambda key: max(shares[key])):
            text = f"{', '.join(key)}: {far[key]} of {len(shares[key])} rows"
            if key in loose:
                remarks.append(f"{text}; excludes: {excluded(study, *key) or 'not stated'}")
            else:
                remarks.append(f"{text}, others use up to {compact(max(shares[key]), 2)} of it")
        hidden = len(remarks) - SHOWN
        more = [f"and {hidden} more subjects and metrics, listed in `replay`"] if hidden > 0 else []
        values = {
            "checks": float(checks),
            "far from the bound": float(sum(far.values())),
            "share": sum(far.values()) / max(checks, 1),
            "loose in every case": float(len(loose)),
            "unexplained": float(sum(not excluded(study, *key) for key in loose)),
        }
        case, budgets = f"more than {LOOSE:g} times the largest error", {"unexplained": 0.0}
        reason, replay = "; ".join(remarks[:SHOWN] + more), {"far from their bounds": remarks}
        if shares:
            result.append(Row(NAME, study, case, "", values, budgets, reason=reason, replay=replay))
    return result
