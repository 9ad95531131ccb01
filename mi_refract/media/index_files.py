"""Indices from files: a table as CSV, a page of refractiveindex.info as YAML, a glass of a Zemax catalogue (AGF).

Wavelengths are in µm, except in CSV files, whose header contains nm or µm. k, the imaginary part of the index, is read
if a file contains it.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_refract.io import safe_files
from mi_refract.io.errors import MissingExtraError
from mi_refract.io.text import parse_number

from .dispersion import NANOMETRES, Medium, Terms, nanometres, power_series, table

LARGEST = 2**24  # largest size of a file in bytes
PREFIX = "file:"
UNIT = re.compile(r"(?<![a-z])(?:(nm)|[uµμ]m)(?![a-z])")  # in the header of a CSV
EXPECTED = "a .csv, a .yml of refractiveindex.info, or a glass of a Zemax catalogue as file:NAME.agf:GLASS"
# Powers of λ of the coefficients of AGF's formulas for n²; for Conrady's formula, 5, for n.
AGF_POWERS: dict[int, tuple[float, ...]] = {
    1: (0, 2, -2, -4, -6, -8),
    5: (0, -1, -3.5),
    10: (0, 2, -2, -4, -6, -8, -10, -12),
    12: (0, 2, -2, -4, -6, -8, 4, 6),
    13: (0, 2, 4, -2, -4, -6, -8, -10, -12),
}
AGF_SELLMEIER = {2: 3, 6: 4, 11: 5}  # n² − 1 = Σ K λ²/(λ² − L): the number of pairs (K, L)


def split(text: str) -> tuple[str, str]:
    """The file and the glass that a text names: ("a.agf", "X") for `file:a.agf:X`; the glass may be "".

    ("", "") for a text that does not name a file.
    """
    if not text.lower().startswith(PREFIX):
        return "", ""
    path = text[len(PREFIX) :].strip()
    catalog = re.fullmatch(r"(?i)(.*\.agf):(.*)", path)
    return (catalog[1], catalog[2].strip()) if catalog else (path, "")


def read(text: str, label: str, find: Callable[[str], Path]) -> Medium:
    """The medium of the file and glass that `text` names, as in `split`.

    ValueError, in one line, for a file that cannot be read or contains no index. MissingExtraError without PyYAML.

    label: the parameter and its value, for the error. find: returns the path of a file from its name in `text`.
    """
    name, glass = split(text)
    path, suffix = find(name), Path(name).suffix.lower()
    try:
        content = safe_files.read_bytes(path, LARGEST)
        if suffix == ".csv":
            medium = _csv(content.decode("utf-8-sig"))
        elif suffix in (".yml", ".yaml"):
            medium = _refractiveindex_info(content.decode("utf-8"))
        elif suffix == ".agf" and glass:
            wide = content.startswith((b"\xff\xfe", b"\xfe\xff"))
            medium = _zemax(content.decode("utf-16" if wide else "latin-1"), glass)
        else:
            raise ValueError(f"expected {EXPECTED}")
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else " ".join(str(error).split())
        raise ValueError(f"{label}: {path}: {reason.removeprefix(f'{path}: ')}") from None
    return medium


def _csv(text: str) -> Medium:
    """A medium from columns of wavelengths, whose name contains the unit, `n`, and optionally `k`; # is a comment."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    rows = [[cell.strip(' "') for cell in re.split(r"[,;\t]", line.rstrip(" ,;\t"))] for line in lines]
    header = [cell.lower() for cell in rows[0]] if rows else []
    units = [(i, unit) for i, cell in enumerate(header) if (unit := UNIT.search(cell))]
    if len(units) != 1 or "n" not in header:
        expected = "a column whose name contains nm or µm, a column n, and optionally k, as in 'nm,n,k'"
        raise ValueError(f"header {','.join(header)!r}; expected {expected}")
    column, unit = units[0]
    in_nm = float if unit[1] else nanometres
    expected = f"expected numbers in the columns {', '.join(header)}, with decimal points, and no more columns"
    if any(len(row) != len(header) for row in rows):  # such as 400;1,52
        raise ValueError(expected)
    try:
        values = [
            [in_nm(parse_number(row[column])), *(parse_number(row[header.index(x)]) for x in "nk" if x in header)]
            for row in rows[1:]
        ]
    except ValueError:
        raise ValueError(expected) from None
    return _tabulated("n" + "k" * ("k" in header), values)


def _tabulated(kind: str, rows: Sequence[Sequence[float]]) -> Medium:
    """A medium from rows of λ in nm and the columns `kind`: "n", "k" or "nk". Without n it has no coefficients."""
    if kind not in ("n", "k", "nk") or {len(row) for row in rows} != {1 + len(kind)}:
        raise ValueError(f"a table of {kind}; expected n, k or nk, and a number for each in every line")
    wavelengths, columns = [row[0] for row in rows], dict(zip(kind, [*zip(*rows, strict=True)][1:], strict=True))
    form, coefficients = table([*zip(wavelengths, columns.get("n", [1.0] * len(rows)), strict=True)])
    k = columns.get("k", ())
    if bad := [x for x in k if not 0 <= x < math.inf]:
        raise ValueError(f"k = {bad[0]:g}; expected a finite number ≥ 0")
    valid = wavelengths[0], wavelengths[-1]
    return Medium("", form, coefficients if "n" in kind else {}, valid, k=(form.knots, tuple(k)) if k else None)


def _refractiveindex_info(text: str) -> Medium:
    """A medium from a page with formula 1, 2, 3, 5 or 6 of its "Dispersion formulas", or a table; the first with n."""
    try:
        import yaml
    except ModuleNotFoundError:
        raise MissingExtraError("YAML needs PyYAML: pip install 'mi-refract[yaml]'") from None
    try:
        page: Any = yaml.safe_load(text)
        entries = [(str(entry["type"]).split(), entry) for entry in page["DATA"]]
        media = [_entry(kind, entry) for kind, entry in entries]
        conditions: dict[str, Any] = (page.get("SPECS") or {}) | (page.get("CONDITIONS") or {})
        absolute = conditions.get("n_is_absolute", conditions.get("n_absolute"))
    except (yaml.YAMLError, KeyError, TypeError, IndexError, AttributeError, ZeroDivisionError):
        raise ValueError("expected a page of refractiveindex.info, with DATA of one formula or table") from None
    if not (with_n := [medium for medium in media if medium.coefficients]):
        raise ValueError("no index; expected a formula, or tabulated n")
    k = next((medium.k for medium in media if medium.k), None)
    relative_to = ""
    if absolute is not None:
        relative_to = "vacuum" if absolute else "air"
    return replace(with_n[0], relative_to=relative_to, k=k)


def _entry(kind: list[str], entry: dict[str, Any]) -> Medium:
    if kind[0] == "tabulated":
        rows = [[parse_number(x) for x in line.split()] for line in entry["data"].splitlines() if line.strip()]
        return _tabulated(kind[1], [[nanometres(row[0]), *row[1:]] for row in rows])
    c = [parse_number(x) for x in str(entry["coefficients"]).split()]
    low, high = (nanometres(parse_number(x)) for x in str(entry.get("wavelength_range") or entry["range"]).split())
    if not len(c) % 2:
        raise ValueError(f"{len(c)} coefficients; expected an odd number of them")
    first, number, pairs = c[0], kind[1], list(zip(c[1::2], c[2::2], strict=True))
    if number in ("3", "5"):
        return Medium("", *power_series(2 if number == "3" else 1, [(first, 0), *pairs]), (low, high))
    if number not in ("1", "2", "6"):
        raise ValueError(f"formula {number}; expected formula 1, 2, 3, 5 or 6, or a table")
    if number == "6":  # n − 1 = C1 + Σ k/(k₀ − λ⁻²), and k/(k₀ − λ⁻²) = (k/k₀) λ²/(λ² − 1/k₀)
        pairs = [(k / k_0, 1 / k_0) for k, k_0 in pairs]
    pairs = [(b, x * x) for b, x in pairs] if number == "1" else pairs
    return _resonances(1 if number == "6" else 2, first, pairs, (low, high))


def _resonances(power: int, first: float, pairs: Sequence[tuple[float, float]], valid: tuple[float, float]) -> Medium:
    """n or n² = 1 + `first` + Σ B λ²/(λ² − C), λ in µm."""
    names = [(f"B{i}", f"C{i}") for i in range(1, len(pairs) + 1)]
    values = {"A": first}
    for (b_name, c_name), (b, c) in zip(names, pairs, strict=True):
        values |= {b_name: b, c_name: c * NANOMETRES**2}
    return Medium("", Terms(power, 1.0, (("A", 0),), tuple(names)), values, valid)


def _zemax(text: str, glass: str) -> Medium:
    """A glass of an AGF catalogue, from lines `NM name formula …`, `CD coefficients`, `LD shortest longest` in µm."""
    glasses: dict[str, dict[str, list[str]]] = {}
    lines: dict[str, list[str]] = {}
    for line in text.splitlines():
        key, *words = line.split() or [""]
        if key == "NM" and words:
            lines = glasses.setdefault(words[0].lower(), {})
        lines[key] = words
    if glass.lower() not in glasses:
        near = ", ".join(x.upper() for x in difflib.get_close_matches(glass.lower(), glasses, 3, 0.0))
        raise ValueError(f"no glass {glass}; nearest: {near or 'none'}")
    lines = glasses[glass.lower()]
    try:
        number, c = int(float(lines["NM"][1])), [parse_number(x) for x in lines["CD"]]
        low, high = (nanometres(parse_number(x)) for x in lines["LD"][:2])
    except (KeyError, IndexError, ValueError):
        raise ValueError(f"glass {glass}: expected a formula, and lines CD and LD of numbers") from None
    if number in AGF_SELLMEIER:
        pairs = [*zip(c[::2], c[1::2], strict=False)][: AGF_SELLMEIER[number]]
        medium = _resonances(2, 0.0, pairs, (low, high))
    elif number in AGF_POWERS:
        terms = zip(c, AGF_POWERS[number], strict=False)
        medium = Medium("", *power_series(1 if number == 5 else 2, terms), (low, high))
    else:
        known = ", ".join(map(str, sorted([*AGF_POWERS, *AGF_SELLMEIER])))
        raise ValueError(f"glass {glass}: formula {number}; expected one of {known}")
    return replace(medium, relative_to="air")
