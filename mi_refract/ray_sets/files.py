"""Files of rays and of answers: CSV, NumPy's .npz, EXR.

    rays      .csv: id, ax, ay, az, nx, ny, nz, n_from, n_to   .npz: id, a, n, n_from, n_to   .exr: one pixel per ray
    answers   .csv: id, bx, by, bz[, transmitted]              .npz: id, b[, transmitted]     .exr: channels as in .csv

A number in CSV is the shortest decimal that reads back, in float64, as exactly that number; a float32 number also reads
back exactly in float32.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io import image_file, regular_file
from mi_refract.io.atomic import writable, write_atomically
from mi_refract.regimes import Rays

from . import header as headers
from . import npz_arrays
from .csv_table import parse_table, with_header
from .header import FORMAT, PRECISIONS, Header
from .ray_set import Answers, RaySet, checksum, indices, regime_names

SUFFIXES = (".csv", ".npz", ".exr")
COLUMNS = ("id", "ax", "ay", "az", "nx", "ny", "nz", "n_from", "n_to")
ANSWER_COLUMNS = ("id", "bx", "by", "bz")
TRANSMITTED = "transmitted"  # the optional column of answers
MOST_RAYS = 2**28 // len(COLUMNS)  # in a file
_CSV_BYTES = 2**32
_EXR_WIDTH = 1024
_EXR_IDS = 2**24  # float32 holds all whole numbers up to this one
_ATTRIBUTE = "mi_refract:rays"


# Writing ---------------------------------------------------------------------------------------------------------


def write(path: str | Path, rays: RaySet) -> Path:
    """Write .csv, .npz or .exr, completely or not at all.

    ValueError for another file ending, or for a set that the format cannot hold: EXR has float32, and ids up to 2²⁴.
    OSError where the file cannot be written.
    """
    path = writable(path, SUFFIXES)
    if path.suffix.lower() == ".exr":
        _write_exr(path, rays)
    else:
        write_atomically(path, as_csv(rays) if path.suffix.lower() == ".csv" else _as_npz(rays))
    return path


def as_csv(rays: RaySet) -> str:
    """The text of the CSV file."""
    return with_header(rays.header, COLUMNS, rays.numbers)


def _as_npz(rays: RaySet) -> bytes:
    n_from, n_to = indices(rays.rays.k)
    arrays = {
        "id": rays.ids,
        "a": rays.rays.a,
        "n": rays.rays.n,
        "n_from": n_from,
        "n_to": n_to,
        "header": np.array(json.dumps(rays.header)),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in arrays.items():
            # A ZipInfo made here has a fixed date: the same set gives the same bytes.
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
    return buffer.getvalue()


def _write_exr(path: Path, rays: RaySet) -> None:
    """One pixel per ray, row by row, at most 1024 pixels wide. Unused pixels of the last row have the id −1."""
    if rays.precision != "f32" or len(rays) > _EXR_IDS:
        raise ValueError(f"{path}: {len(rays)} rays in {rays.precision}; accepted in EXR: f32, up to {_EXR_IDS}")
    width = min(len(rays), _EXR_WIDTH)
    height = -(-len(rays) // width)
    pixels = np.zeros((height * width, len(COLUMNS)), np.float32)
    pixels[len(rays) :, 0] = -1
    pixels[: len(rays)] = rays.numbers
    metadata = {_ATTRIBUTE: json.dumps(rays.header), **image_file.NO_DATE}
    image_file.write_exr(path, pixels.reshape(height, width, -1), COLUMNS, metadata)


# Reading ---------------------------------------------------------------------------------------------------------


def read(path: str | Path) -> RaySet:
    """The rays of a file that is as `write` left it.

    ValueError, one line, for another format, a missing header, a cell that is not a number, or a checksum that does not
    match (a file that was edited or cut short). OSError where the file cannot be read.
    """
    path = _with_known_suffix(path)
    header, numbers = _read(path, {"a": 3, "n": 3, "n_from": 1, "n_to": 1}, COLUMNS, most=MOST_RAYS)
    if header.get("format") != FORMAT:
        raise ValueError(f"{path}: not a file of rays; accepted: what `mi-refract rays export` writes ({FORMAT})")
    try:
        headers.check(header, len(numbers))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    rays = _ray_set(header, numbers)
    if checksum(rays) != header["checksum"] or not np.array_equal(rays.numbers, numbers):
        found = "the checksum does not match, so it was edited or cut short"
        raise ValueError(f"{path}: {found}; accepted: the file as it was exported")
    if wrong := _first_without_meaning(rays):
        raise ValueError(f"{path}: {wrong}; accepted: finite vectors that are not zero, finite indices above 0")
    return rays


def _ray_set(header: Header, numbers: np.ndarray) -> RaySet:
    precision = PRECISIONS[header["precision"]]
    with np.errstate(all="ignore"):
        a, n, k = numbers[:, 1:4], numbers[:, 4:7], numbers[:, 7] / numbers[:, 8]
        rays = Rays(*(x.astype(precision) for x in (a, n, k)))
    ids = np.arange(len(numbers))
    return RaySet(rays, ids, regime_names(header, len(ids)), header)


def _first_without_meaning(rays: RaySet) -> str:
    """Of the rays that have no refraction, the first; "" where there is none."""
    a, n, k = rays.rays.a, rays.rays.n, rays.rays.k
    good = np.isfinite(a).all(1) & np.isfinite(n).all(1) & a.any(1) & n.any(1) & np.isfinite(k) & (k > 0)
    return "" if good.all() else f"ray {np.argmin(good)} is none"


def read_answers(path: str | Path, *, most: int = MOST_RAYS) -> Answers:
    """The answers in a file: `most` at most.

    ValueError, one line, where it holds none, or more. OSError where it cannot be read.
    """
    path = _with_known_suffix(path)
    return _answers(str(path), *_read(path, {"b": 3, TRANSMITTED: 1}, ANSWER_COLUMNS, TRANSMITTED, most=most))


def parse_answers(text: str | bytes, name: str = "answers") -> Answers:
    """The answers in the text of a CSV file. ValueError, one line that begins with `name`, where it holds none."""
    return _answers(name, *parse_table(name, text, ANSWER_COLUMNS, TRANSMITTED))


def most_answers(rays: RaySet) -> int:
    """The most rows that answers to these rays may have: twice as many, and some for small sets."""
    return 2 * len(rays) + 100


def csv_bytes(rows: int) -> int:
    """The largest size of a CSV file with so many rows: five times what their digits need, and 1 MiB for the header."""
    return min(rows * 1024 + 2**20, _CSV_BYTES)


def _with_known_suffix(path: str | Path) -> Path:
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: accepted: a file name that ends in {' or '.join(SUFFIXES)}")
    return path


def _answers(name: str, header: Header, numbers: np.ndarray) -> Answers:
    ids = numbers[:, 0]
    if (wrong := ~(np.abs(ids) < 2**53) | (np.rint(ids) != ids)).any():
        found = f"{wrong.sum()} ids are not whole numbers below 2^53, the first is {ids[wrong][0]:g}"
        raise ValueError(f"{name}: {found}; accepted: the ids of the rays")
    flags = numbers[:, 4] if numbers.shape[1] > 4 else None
    if flags is not None and (wrong := ~np.isin(flags, (0, 1))).any():
        raise ValueError(f"{name}: {TRANSMITTED} is {flags[wrong][0]} for {wrong.sum()} rays; accepted: 0 or 1")
    return Answers(ids.astype(np.int64), numbers[:, 1:4], None if flags is None else flags == 1, header)


def _read(
    path: Path, arrays: dict[str, int], columns: Sequence[str], *optional: str, most: int
) -> tuple[Header, np.ndarray]:
    """(header, (N, columns) float64) of any format, N up to `most`.

    `arrays`: the arrays of an .npz file and their widths.
    """
    header, numbers = _read_any(path, arrays, columns, optional, most)
    if len(numbers) > most:
        raise ValueError(f"{path}: {len(numbers)} rows; accepted: up to {most}")
    return header, numbers


def _read_any(
    path: Path, arrays: dict[str, int], columns: Sequence[str], optional: Sequence[str], most: int
) -> tuple[Header, np.ndarray]:
    if path.suffix.lower() == ".csv":
        return parse_table(str(path), regular_file.read_bytes(path, csv_bytes(most)), columns, *optional)
    if path.suffix.lower() == ".npz":
        text, numbers = npz_arrays.read(path, {"id": 1, **arrays}, optional, most)
        return _header(text), numbers
    image = image_file.read(path)
    chosen = [*columns, *(name for name in optional if name in image.channels)]
    pixels = image.select(chosen).reshape(-1, len(chosen)).astype(np.float64)
    return _header(image.metadata.get(_ATTRIBUTE, "")), pixels[pixels[:, 0] != -1]


def _header(text: Any) -> Header:
    """The header in JSON text, empty where there is none."""
    try:
        header = headers.as_json(text) if isinstance(text, str) else {}
    except ValueError:
        return {}
    return header if isinstance(header, dict) else {}
