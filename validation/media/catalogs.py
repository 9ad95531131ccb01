"""Glasses of the makers' catalogues, at the spectral lines for which an index is printed.

Makers print coefficients of a formula and, beside them, indices with five or six decimals. Of each glass the formula
is evaluated here, and by the package that holds the catalogues; both must agree to rounding. Schott's and Hikari's
formulas give all of their printed indices. Those of the other makers miss many of their own by a few units of the fifth
decimal: the row says of how many glasses, and by how much. V_d is compared with the printed one.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

from mi_refract import media
from mi_refract.media import LINES, glass_catalogs
from mi_refract.report.row import Row
from validation.limits import CATALOG_FORMULA, PRINTED_INDEX
from validation.run.context import Context
from validation.study import Study, Task, about

CONSISTENT = "SCHOTT", "HIKARI"  # whose formulas give all of their printed indices
TERMS = {
    "glasses": "of the catalogue, with a formula",
    "formula error": "largest difference from the index that the package gives for the same coefficients, relative",
    "largest miss": "largest difference of an index from the printed one",
    "missing": "glasses of which a printed index is missed by more than half a unit of the fifth decimal and 1e-6",
    "V_d off": "largest difference of V_d from the printed one",
}


def _rows(context: Context) -> list[Row]:
    absent = [name for name in ("opticalglass", "pandas") if find_spec(name) is None]
    if absent:
        reason = f"{absent[0]} is not installed: pip install 'mi-refract[glass]'"
        return [Row(STUDY.name, "catalogues", "printed lines", "", reason=reason)]
    return [_row(catalog) for catalog in glass_catalogs.CATALOGS]


def _row(catalog: str) -> Row:
    glasses = {name: glass for name, glass in glass_catalogs.read(catalog).items() if glass.coefficients}
    misses = {name: max(_misses(f"{catalog}:{name}", glass.printed), default=0.0) for name, glass in glasses.items()}
    found = {
        "glasses": len(glasses),
        "formula error": max(_formula_errors(catalog, glasses)),
        "largest miss": max(misses.values()),
        "missing": sum(miss > PRINTED_INDEX for miss in misses.values()),
        "V_d off": max(abs(_v_d(f"{catalog}:{name}") - glass.v_d) for name, glass in glasses.items()),
    }
    budgets = {"formula error": CATALOG_FORMULA}
    if catalog in CONSISTENT:
        budgets |= {"largest miss": PRINTED_INDEX}
    worst = max(misses, key=lambda name: misses[name])
    values = {name: float(x) for name, x in found.items()}
    return Row(STUDY.name, catalog, "printed lines", "float64", values, budgets, replay={"glass": f"{catalog}:{worst}"})


def _misses(glass: str, printed: dict[str, float]) -> Iterator[float]:
    medium = media.parse(glass)
    return (abs(medium.index(LINES[line]) - n) for line, n in printed.items())


def _formula_errors(catalog: str, glasses: dict[str, Any]) -> Iterator[float]:
    from opticalglass.glass import glass_catalog_factory

    table: Any = glass_catalog_factory(catalog if catalog == "CDGM" else catalog.capitalize())
    names = {str(name).strip(): name for name in table.df.index}
    for name, glass in glasses.items():
        medium, other = media.parse(f"{catalog}:{name}"), table.create_glass(names[name], catalog)
        for line in glass.printed:
            yield abs(medium.index(LINES[line]) / float(other.calc_rindex(LINES[line])) - 1)


def _v_d(glass: str) -> float:
    n = {line: media.index(glass, LINES[line]) for line in "dFC"}
    return float((n["d"] - 1) / (n["F"] - n["C"]))


STUDY = Study(
    "media",
    "Indices of glass catalogues",
    about(__doc__),
    TERMS,
    lambda context: [Task("catalogues of glass", lambda: _rows(context))],
)
