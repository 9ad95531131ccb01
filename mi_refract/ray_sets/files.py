"""Files of rays and of answers: CSV, NumPy's .npz, EXR.

    rays      .csv: id, ax, ay, az, nx, ny, nz, n_from, n_to   .npz: id, a, n, n_from, n_to   .exr: one pixel per ray
    answers   .csv: id, bx, by, bz[, transmitted][, n_ratio]   .npz: id, b[, …]               .exr: channels as in .csv

Rays with media have two columns, arrays or channels more: wavelength, medium.

A number in CSV is the shortest decimal that reads back, in float64, as exactly that number; a float32 number also reads
back exactly in float32.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence, Sized
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mi_refract.io import image_file, regular_file
from mi_refract.io.atomic import writable, write_atomically
from mi_refract.regimes import Array, Rays

from . import csv_table, media_rays, npz_arrays
from . import header as headers
from .csv_table import with_header
from .header import FORMAT, PRECISIONS, Header
from .ray_set import ROWS, Answers, RaySet, checksum, indices

SUFFIXES = (".csv", ".npz", ".exr")
COLUMNS = ("id", "ax", "ay", "az", "nx", "ny", "nz", "n_from", "n_to")
ANSWER_COLUMNS = ("id", "bx", "by", "bz")
TRANSMITTED, N_RATIO = "transmitted", "n_ratio"  # optional columns of answers, each with or without the other
WITH_MEDIA = (",".join(media_rays.COLUMNS),)  # of rays: both, or none
RAY_ARRAYS = {"a": 3, "n": 3, "n_from": 1, "n_to": 1, **dict.fromkeys(media_rays.COLUMNS, 1)}  # of .npz: their widths
ANSWER_ARRAYS = {"b": 3, TRANSMITTED: 1, N_RATIO: 1}
LEAST_RATIO = 1e-9  # of answers: a thousandth of the least in any set
MOST_RAYS = 2**28 // len(COLUMNS)  # 3e7: their numbers take 2 GiB, and checking them takes 8 GB
_ROW_BYTES, _TOP_BYTES = 1024, 2**20  # of CSV: five times what the digits of a row need; for the header
_TEXT_BYTES = 2**32  # of CSV in memory
_EXR_WIDTH = 1024
_EXR_IDS = 2**24  # float32 holds all whole numbers up to this one
_ATTRIBUTE = "mi_refract:rays"

Table = tuple[Header, Array, tuple[str, ...]]  # the header, (N, columns) float64, and the columns' names


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
    return with_header(rays.header, _columns(rays.header), rays.numbers, whole=media_rays.WHOLE)


def _columns(header: Header) -> tuple[str, ...]:
    return (*COLUMNS, *(media_rays.COLUMNS if media_rays.has_media(header) else ()))


def _as_npz(rays: RaySet) -> bytes:
    n_from, n_to = indices(rays.rays.k)
    arrays = {"id": rays.ids, "a": rays.rays.a, "n": rays.rays.n, "n_from": n_from, "n_to": n_to}
    if media_rays.has_media(rays.header):
        wavelength, medium = media_rays.columns(rays.header, rays.ids).T
        arrays |= {"wavelength": wavelength.astype(rays.rays.k.dtype), "medium": medium.astype(np.int64)}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in {**arrays, "header": np.array(json.dumps(rays.header))}.items():
            # A ZipInfo made here has a fixed date: the same set gives the same bytes.
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
    return buffer.getvalue()


def _write_exr(path: Path, rays: RaySet) -> None:
    """One pixel per ray, row by row, at most 1024 pixels wide. Unused pixels of the last row have the id −1."""
    if rays.precision != "f32" or len(rays) > _EXR_IDS:
        raise ValueError(f"{path}: {len(rays)} rays in {rays.precision}; expected in EXR: f32, up to {_EXR_IDS}")
    width = min(len(rays), _EXR_WIDTH)
    height = -(-len(rays) // width)
    columns = _columns(rays.header)
    pixels = np.zeros((height * width, len(columns)), np.float32)
    pixels[len(rays) :, 0] = -1
    pixels[: len(rays)] = rays.numbers
    metadata = {_ATTRIBUTE: json.dumps(rays.header), **image_file.NO_DATE}
    image_file.write_exr(path, pixels.reshape(height, width, -1), columns, metadata)


# Reading ---------------------------------------------------------------------------------------------------------


def read(path: str | Path) -> RaySet:
    """The rays of a file that is as `write` left it.

    ValueError, one line, for another format, more than MOST_RAYS, a missing header, a cell that is not a number, or a
    checksum that does not match (a file that was edited or cut short). OSError where the file cannot be read.
    """
    path = Path(path)
    header, numbers, _ = _read(path, RAY_ARRAYS, COLUMNS, WITH_MEDIA, MOST_RAYS)
    try:
        if header.get("format") != FORMAT:
            raise ValueError(f"not a file of rays; expected what `mi-refract rays export` writes ({FORMAT})")
        headers.check(header, len(numbers))
        media_rays.check(header)
        rays = RaySet(_rays(header, numbers), np.arange(len(numbers)), header)
        pieces = enumerate(rays.numbers_in_pieces())
        same = all(np.array_equal(piece, numbers[i * ROWS : (i + 1) * ROWS]) for i, piece in pieces)
        if not same or checksum(rays) != header["checksum"]:
            found = "the checksum does not match, so it was edited or cut short"
            raise ValueError(f"{found}; expected the file as it was exported")
        _check_rays(rays.rays)
        media_rays.check_ratios(header, rays.rays.k)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return rays


def _rays(header: Header, numbers: Array) -> Rays:
    precision = PRECISIONS[header["precision"]]
    with np.errstate(all="ignore"):
        a, n, k = numbers[:, 1:4], numbers[:, 4:7], numbers[:, 7] / numbers[:, 8]
        return Rays(*(x.astype(precision) for x in (a, n, k)))


def _check_rays(rays: Rays) -> None:
    """ValueError, one line, where a ray has no refraction."""
    a, n, k = rays.a, rays.n, rays.k
    valid = np.isfinite(a).all(1) & np.isfinite(n).all(1) & a.any(1) & n.any(1) & np.isfinite(k) & (k > 0)
    if not valid.all():
        raise ValueError(f"ray {np.argmin(valid)} is invalid: zero or non-finite vector, or index ≤ 0")


def read_answers(path: str | Path, *, most: int = MOST_RAYS) -> Answers:
    """The answers in a file, `most` at most.

    ValueError, one line, where it holds none, or more. OSError where it cannot be read.
    """
    path = Path(path)
    return _answers(str(path), *_read(path, ANSWER_ARRAYS, ANSWER_COLUMNS, (TRANSMITTED, N_RATIO), most))


def parse_answers(text: str | bytes, name: str = "answers") -> Answers:
    """The answers in the text of a CSV file. ValueError, one line that begins with `name`, where it holds none."""
    stream = io.BytesIO(text.encode() if isinstance(text, str) else text)
    return _answers(name, *csv_table.read_table(name, stream, ANSWER_COLUMNS, (TRANSMITTED, N_RATIO), MOST_RAYS))


def most_answers(rays: Sized) -> int:
    """The most rows that answers to these rays may have: twice as many, and some for small sets."""
    return 2 * len(rays) + 100


def csv_bytes(rows: int) -> int:
    """The largest size of CSV text with so many rows, in memory."""
    return min(rows * _ROW_BYTES + _TOP_BYTES, _TEXT_BYTES)


def _answers(name: str, header: Header, numbers: Array, names: Sequence[str]) -> Answers:
    columns = dict(zip(names, numbers.T, strict=True))
    ids, flags, ratios = columns["id"], columns.get(TRANSMITTED), columns.get(N_RATIO)
    if len(wrong := ids[~(np.abs(ids) < 2**53) | (np.rint(ids) != ids)]):
        found = f"{len(wrong)} ids are not whole numbers below 2^53, the first is {wrong[0]:g}"
        raise ValueError(f"{name}: {found}; expected the ids of the rays")
    if flags is not None and len(wrong := flags[~np.isin(flags, (0, 1))]):
        raise ValueError(f"{name}: {TRANSMITTED} is {wrong[0]} for {len(wrong)} rays; expected 0 or 1")
    if ratios is not None and len(wrong := ratios[~((ratios >= LEAST_RATIO) & (ratios <= 1 / LEAST_RATIO))]):
        found = f"{N_RATIO} is {wrong[0]:g} for {len(wrong)} rays"
        raise ValueError(f"{name}: {found}; expected n_from / n_to, {LEAST_RATIO:g} … {1 / LEAST_RATIO:g}")
    return Answers(ids.astype(np.int64), numbers[:, 1:4], None if flags is None else flags == 1, header, ratios)


def _read(path: Path, arrays: Mapping[str, int], columns: Sequence[str], optional: Sequence[str], most: int) -> Table:
    """The table in a file of any format, with `most` rows at most.

    `arrays`: the arrays of an .npz file beside `id`, and their widths.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: expected a file name that ends in {' or '.join(SUFFIXES)}")
    if path.suffix.lower() == ".csv":
        with regular_file.opened(path, most * _ROW_BYTES + _TOP_BYTES) as stream:
            return csv_table.read_table(str(path), stream, columns, optional, most)
    if path.suffix.lower() == ".npz":
        text, numbers, present = npz_arrays.read(path, {"id": 1, **arrays}, csv_table.flat(optional), most)
        return _header(text), numbers, (*columns, *(name for name in csv_table.flat(optional) if name in present))
    image = image_file.read(path)
    names = (*columns, *(name for name in csv_table.flat(optional) if name in image.channels))
    pixels: NDArray[np.float64] = image.select(names).reshape(-1, len(names)).astype(np.float64)
    numbers = pixels[pixels[:, 0] != -1]
    if len(numbers) > most:
        raise ValueError(f"{path}: {len(numbers)} rows; expected up to {most}")
    return _header(image.metadata.get(_ATTRIBUTE, "")), numbers, names


def _header(text: object) -> Header:
    """The header in JSON text, empty where there is none."""
    try:
        header = headers.as_json(text) if isinstance(text, str) else {}
    except ValueError:
        return {}
    return header if isinstance(header, dict) else {}
