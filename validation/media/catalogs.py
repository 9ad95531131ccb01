"""Glasses of the makers' catalogues, at the spectral lines with printed indices.

The package has the coefficients of the makers' formulas in one file. It was made from the makers' spreadsheets, which
are read here by the package `opticalglass`. Makers print the coefficients of a formula and also indices with five or
six decimals. The formula of each glass is evaluated with the coefficients of the file, and by `opticalglass` with those
of the spreadsheet; both must agree up to rounding. The formulas of Schott and Hikari give all of their printed indices.
Those of the other makers miss many printed indices by a few units of the fifth decimal: the row gives the number of
such glasses and the largest difference. V_d is compared with the printed one.

`python -c 'from validation.media import catalogs; catalogs.write()'` writes the file again, after a new edition of
`opticalglass`; SOURCES names the documents that its spreadsheets come from.
"""

from __future__ import annotations

import importlib
import json
import math
import warnings
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract import media
from mi_refract.media import LINES, glass_catalogs
from mi_refract.report.row import Row
from validation.limits import CATALOG_FORMULA, PRINTED_INDEX
from validation.run.context import Context
from validation.study import Study, Task, about

READERS = "opticalglass", "pandas"  # packages that read the spreadsheets
ABSENT = "{} is not installed: bash .ci/setup validation"
CONSISTENT = "SCHOTT", "HIKARI"  # makers whose formulas give all of their printed indices
# Range of the fit, in nm. Hoya prints values of its formula beyond the t line: there no glass is off by more than the
# last digit, below the t line a third of them are. Schott's fit starts at the i line: most of the indices printed for
# shorter wavelengths are off by 1e-5 to 4e-5.
FITTED = {"HOYA": (365.0, 1014.0), "SCHOTT": (365.0, 2326.0)}
ANY = (0.0, math.inf)
# The spreadsheets of opticalglass 1.1.1, with the names and dates that they contain.
SOURCES = {
    "CDGM": "CDGM, optical glass, spreadsheet of September 2018",
    "HIKARI": "Hikari, general catalog data, revision of 2020-04-01",
    "HOYA": "Hoya, glass data table of 2018-12-15",
    "OHARA": "Ohara, recommended glasses, spreadsheet of 2018-05-14",
    "SCHOTT": "Schott, optical glass datatable of 2018-06-01",
    "SUMITA": "Sumita, optical glass data, version 12.00.05 of 2020-07-29",
}
TERMS = {
    "glasses": "number of glasses of the catalogue with a formula",
    "formula error": "largest relative difference from the index that `opticalglass` gives for the spreadsheet",
    "largest miss": "largest difference of an index from the printed one",
    "missing": "glasses with a printed index that is missed by more than half a unit of the fifth decimal plus 1e-6",
    "V_d off": "largest difference of V_d from the printed one",
}


@dataclass(frozen=True)
class Printed:
    """What a maker prints of a glass. `entry`: its entry in the package's file."""

    entry: glass_catalogs.Glass
    lines: dict[str, float]  # n at spectral lines
    v_d: float
    name: str  # in opticalglass


def tables(catalog: str) -> tuple[Any, dict[str, Printed]]:
    """Return a maker's spreadsheet as `opticalglass`'s object, and all its glasses by name.

    A glass is valid between the wavelengths for which its maker prints an index or a transmittance above 0. Its formula
    is fitted in the range of the printed indices (Ohara's technical information, 2.3), or in the part in FITTED.
    """
    module: Any = importlib.import_module(f"opticalglass.{catalog.lower()}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        (name,) = [name for name in vars(module) if name.lower() == f"{catalog.lower()}catalog"]
        table, most, glasses = getattr(module, name)(), FITTED.get(catalog, ANY), {}
        for name, row in table.df.iterrows():
            printed, transmitting = _finite(row["refractive indices"]), _finite(row["internal transmission mm, 10"])
            lines = [float(LINES.get(line, line)) for line in printed if line in LINES or isinstance(line, float)]
            wavelengths = lines + [float(w) for w, share in transmitting.items() if share > 0]
            c = row["dispersion coefficients"].tolist()
            if len(_finite(row["dispersion coefficients"])) < len(c):
                c = []
            if catalog == "HOYA":  # mantissas, each before its exponent of ten
                c = [float(f"{x!r}e{int(y)}") for x, y in zip(c[::2], c[1::2], strict=True)]
            fitted = max(math.floor(min(lines)), most[0]), min(math.ceil(max(lines)), most[1])
            glasses[str(name).strip()] = Printed(
                glass_catalogs.Glass((min(wavelengths), max(wavelengths)), fitted, tuple(map(float, c))),
                {line: n for line, n in printed.items() if line in LINES},
                float(row["abbe number"]["vd"]),
                str(name),
            )
    return table, glasses


def _finite(series: Any) -> dict[Any, float]:
    """Return the entries that are finite numbers, by column: a line's letter or a wavelength in nm."""
    pandas: Any = importlib.import_module("pandas")
    numbers = pandas.to_numeric(series, errors="coerce")
    return {column: float(x) for column, x in numbers.items() if math.isfinite(x)}


def write(path: Path = glass_catalogs.FILE) -> None:
    """Write the package's file of glasses, one line per glass, sorted."""

    def numbers(values: tuple[float, ...]) -> list[float]:
        return [int(x) if x == int(x) else x for x in values]

    parts = []
    for catalog, source in SOURCES.items():
        glasses = {name: [*map(numbers, printed.entry)] for name, printed in tables(catalog)[1].items()}
        lines = [f"  {json.dumps(name)}: {json.dumps(glasses[name])}" for name in sorted(glasses)]
        parts.append(f' "{catalog}": {{"source": {json.dumps(source)}, "glasses": {{\n' + ",\n".join(lines) + "}}")
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n", "utf-8")


def rows(context: Context) -> list[Row]:
    """Return one row per catalogue."""
    absent = [name for name in READERS if find_spec(name) is None]
    if absent:
        return [Row(STUDY.name, "catalogues", "printed lines", "", reason=ABSENT.format(absent[0]))]
    return [catalog_row(catalog) for catalog in glass_catalogs.CATALOGS]


def catalog_row(catalog: str) -> Row:
    """Return the row of all glasses with a formula, at all printed lines."""
    table, glasses = tables(catalog)
    misses, errors, v_d = dict[str, float](), list[float](), list[float]()
    for name, printed in glasses.items():
        if printed.entry.coefficients:
            medium, other = media.parse(f"{catalog}:{name}"), table.create_glass(printed.name, catalog)
            n: dict[str, Any] = {line: medium.index(LINES[line]) for line in {*printed.lines, *"dFC"}}
            errors += [abs(n[line] / float(other.calc_rindex(LINES[line])) - 1) for line in printed.lines]
            misses[name] = max((abs(n[line] - at_line) for line, at_line in printed.lines.items()), default=0.0)
            v_d.append(abs((n["d"] - 1) / (n["F"] - n["C"]) - printed.v_d))
    missing = sum(miss > PRINTED_INDEX for miss in misses.values())
    values = {"glasses": len(misses), "formula error": np.max(errors), "largest miss": np.max([*misses.values()])}
    values |= {"missing": missing, "V_d off": np.max(v_d)}
    budgets = {"formula error": CATALOG_FORMULA}
    budgets |= {"largest miss": PRINTED_INDEX} if catalog in CONSISTENT else {}
    numbers, worst = {name: float(x) for name, x in values.items()}, max(misses, key=lambda name: misses[name])
    replay = {"glass": f"{catalog}:{worst}"}
    return Row(STUDY.name, catalog, "printed lines", "float64", numbers, budgets, replay=replay)


def tasks(context: Context) -> list[Task]:
    """Return the one task of the study."""
    return [Task("catalogues of glass", lambda: rows(context))]


STUDY = Study("media", "Indices of glass catalogues", about(__doc__), TERMS, tasks)
