"""Bounds far above the errors: budgets that are more than 100 times the largest error seen.

A row per study: how many of its checks are that far from their bound, and for each subject and metric the largest share
of the bound that any case uses. Where one case comes near, the bound is that of the hardest case. Where none does, the
row must say what the bound still excludes: `EXCLUDES`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from mi_refract.io.text import compact
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
DIFFUSE = "roundings of thousands of nodes average out; 12.5 u = 7.5e-7 excludes an index off by 1e-6"
EXCLUDES = {
    **{("energy", f"{side}: {power} / u"): DIFFUSE for side in ("inside", "outside") for power in ("R", "1 − R")},
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
        shares: dict[tuple[str, str], list[float]] = {}  # by subject and metric: value over bound of every case
        for row in members:
            for metric, bound in row.budgets.items() if row.values else ():
                if bound > 0 and math.isfinite(row.values[metric]):
                    shares.setdefault((row.subject, metric), []).append(row.values[metric] / bound)
        checks = sum(map(len, shares.values()))
        far = {key: count for key, used in shares.items() if (count := sum(LOOSE * x < 1 for x in used))}
        loose = {key for key, count in far.items() if count == len(shares[key])}
        said = []
        for key in sorted(far, key=lambda key: max(shares[key])):
            text = f"{', '.join(key)}: {far[key]} of {len(shares[key])} rows"
            if key in loose:
                said.append(f"{text}; excludes: {EXCLUDES.get((study, key[1]), 'not stated')}")
            else:
                said.append(f"{text}, others use up to {compact(max(shares[key]), 2)} of it")
        more = [f"and {len(said) - SHOWN} more subjects and metrics, listed in `replay`"] if len(said) > SHOWN else []
        values = {
            "checks": float(checks),
            "far from the bound": float(sum(far.values())),
            "share": sum(far.values()) / max(checks, 1),
            "loose in every case": float(len(loose)),
            "unexplained": float(sum((study, metric) not in EXCLUDES for _, metric in loose)),
        }
        case, budgets = f"more than {LOOSE:g} times the largest error", {"unexplained": 0.0}
        reason, replay = "; ".join(said[:SHOWN] + more), {"far from their bounds": said}
        if shares:
            made.append(Row(NAME, study, case, "", values, budgets, reason=reason, replay=replay))
    return made
