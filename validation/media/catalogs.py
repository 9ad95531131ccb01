"""Glasses of the makers' catalogues, at the spectral lines for which an index is printed.

Makers print coefficients of a formula and, beside them, indices with five or six decimals. Of each glass the formula
is evaluated here, and by the package that holds the catalogues; both must agree to rounding. Schott's and Hikari's
formulas give all of their printed indices. Those of the other makers miss many of their own by a few units of the fifth
decimal: the row says of how many glasses, and by how much. V_d is compared with the printed one.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np

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


def rows(context: Context) -> list[Row]:
    """One per catalogue."""
    absent = [name for name in ("opticalglass", "pandas") if find_spec(name) is None]
    if absent:
        reason = f"{absent[0]} is not installed: pip install 'mi-refract[glass]'"
        return [Row(STUDY.name, "catalogues", "printed lines", "", reason=reason)]
    return [catalog_row(catalog) for catalog in glass_catalogs.CATALOGS]


def catalog_row(catalog: str) -> Row:
    """Every glass that has a formula, at every line that is printed."""
    from opticalglass.glass import glass_catalog_factory

    glasses = glass_catalogs.read(catalog)  # first: the package warns while it reads
    table: Any = glass_catalog_factory(catalog if catalog == "CDGM" else catalog.capitalize())
    others, misses, errors, v_d = (
        {str(name).strip(): name for name in table.df.index},
        dict[str, float](),
        list[float](),
        list[float](),
    )
    for name, glass in glasses.items():
        if glass.coefficients:
            medium, other = media.parse(f"{catalog}:{name}"), table.create_glass(others[name], catalog)
            n: dict[str, Any] = {line: medium.index(LINES[line]) for line in {*glass.printed, *"dFC"}}
            errors += [abs(n[line] / float(other.calc_rindex(LINES[line])) - 1) for line in glass.printed]
            misses[name] = max((abs(n[line] - printed) for line, printed in glass.printed.items()), default=0.0)
            v_d.append(abs((n["d"] - 1) / (n["F"] - n["C"]) - glass.v_d))
    missing = sum(miss > PRINTED_INDEX for miss in misses.values())
    values = {"glasses": len(misses), "formula error": np.max(errors), "largest miss": np.max([*misses.values()])}
    values |= {"missing": missing, "V_d off": np.max(v_d)}
    budgets = {"formula error": CATALOG_FORMULA}
    budgets |= {"largest miss": PRINTED_INDEX} if catalog in CONSISTENT else {}
    numbers, worst = {name: float(x) for name, x in values.items()}, max(misses, key=lambda name: misses[name])
    replay = {"glass": f"{catalog}:{worst}"}
    return Row(STUDY.name, catalog, "printed lines", "float64", numbers, budgets, replay=replay)


def tasks(context: Context) -> list[Task]:
    """One."""
    return [Task("catalogues of glass", lambda: rows(context))]


STUDY = Study("media", "Indices of glass catalogues", about(__doc__), TERMS, tasks)
