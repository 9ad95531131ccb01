"""Files of rays and of answers: CSV, NumPy's .npz, EXR.

    rays      .csv: id, ax, ay, az, nx, ny, nz, n_from, n_to   .npz: id, a, n, n_from, n_to   .exr: one pixel per ray
    answers   .csv: id, bx, by, bz[, transmitted][, n_ratio]   .npz: id, b[, …]               .exr: channels as in .csv

Rays with media have two columns, arrays or channels more: wavelength, medium.

A number in CSV is the shortest decimal that reads back, in float64, as exactly that number; a float32 number also reads
back exactly in float32.
"""

from __future__ import annotations

import contextlib
import io
import json
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io import image_file, regular_file
from mi_refract.io.atomic import writable, write_atomically
from mi_refract.regimes import Rays

from . import csv_table, media_rays, npz_arrays, stored_answers
from . import header as headers
from .csv_table import parse_table, read_table, with_header
from .header import FORMAT, PRECISIONS, Header
from .ray_set import Answers, RaySet, checksum, indices, regime_names
from .stored_answers import StoredAnswers
from .stored_rays import STEP, RayStore, StoredRays

SUFFIXES = (".csv", ".npz", ".exr")
COLUMNS = ("id", "ax", "ay", "az", "nx", "ny", "nz", "n_from", "n_to")
ANSWER_COLUMNS = ("id", "bx", "by", "bz")
TRANSMITTED, N_RATIO = "transmitted", "n_ratio"  # optional columns of answers, each with or without the other
WITH_MEDIA = (",".join(media_rays.COLUMNS),)  # of rays: both, or none
RAY_ARRAYS = {"a": 3, "n": 3, "n_from": 1, "n_to": 1, **dict.fromkeys(media_rays.COLUMNS, 1)}  # of .npz: their widths
ANSWER_ARRAYS = {"b": 3, TRANSMITTED: 1, N_RATIO: 1}
LEAST_RATIO = 1e-9  # of answers: a thousandth of the least in any set
MOST_RAYS = 2**28 // len(COLUMNS)  # in memory: their numbers take 2 GiB
MOST_STORED = 2**30  # in a file: what is kept in memory of each, once it is judged, is a byte at most
_CSV_BYTES = 2**32
_ROW_BYTES, _TOP_BYTES = 1024, 2**20  # of a CSV file: five times what the digits of a row need; for the header
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
    return with_header(rays.header, _columns(rays.header), rays.numbers, whole=media_rays.WHOLE)


def _columns(header: Header) -> tuple[str, ...]:
    return (*COLUMNS, *(media_rays.COLUMNS if media_rays.has_media(header) else ()))


def _as_npz(rays: RaySet) -> bytes:
    n_from, n_to = indices(rays.rays.k)
    arrays = {
        "id": rays.ids,
        "a": rays.rays.a,
        "n": rays.rays.n,
        "n_from": n_from,
        "n_to": n_to,
        **_media_arrays(rays),
        "header": np.array(json.dumps(rays.header)),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in arrays.items():
            # A ZipInfo made here has a fixed date: the same set gives the same bytes.
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
    return buffer.getvalue()


def _media_arrays(rays: RaySet) -> dict[str, np.ndarray]:
    if not media_rays.has_media(rays.header):
        return {}
    wavelength, medium = media_rays.columns(rays.header, rays.ids).T
    return {"wavelength": wavelength.astype(rays.rays.k.dtype), "medium": medium.astype(np.int64)}


def _write_exr(path: Path, rays: RaySet) -> None:
    """One pixel per ray, row by row, at most 1024 pixels wide. Unused pixels of the last row have the id −1."""
    if rays.precision != "f32" or len(rays) > _EXR_IDS:
        raise ValueError(f"{path}: {len(rays)} rays in {rays.precision}; accepted in EXR: f32, up to {_EXR_IDS}")
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
    """The rays of a file that is as `write` left it, in memory.

    ValueError, one line, for another format, a missing header, a cell that is not a number, or a checksum that does not
    match (a file that was edited or cut short). OSError where the file cannot be read.
    """
    path = _with_known_suffix(path)
    header, numbers, _ = _read(path, RAY_ARRAYS, COLUMNS, *WITH_MEDIA, most=MOST_RAYS)
    _check_header(path, header, len(numbers))
    rays = _ray_set(header, numbers)
    same = checksum(rays) == header["checksum"] and np.array_equal(rays.numbers, numbers)
    _check_rays(path, same, _first_without_meaning(rays.rays), media_rays.first_other_ratio(header, rays.rays.k))
    return rays


def read_stored(path: str | Path) -> StoredRays:
    """As `read`, outside of the memory."""
    path = _with_known_suffix(path)
    with _opened(path, RAY_ARRAYS, COLUMNS, WITH_MEDIA, MOST_STORED) as found:
        _check_header(path, found.header, found.rows)
        kept, same, wrong, other = RayStore(found.header), True, "", ""
        for numbers in found.pieces(STEP):
            first, rays = kept.filled, _rays(found.header, numbers)
            same = np.array_equal(kept.add(rays), numbers) and same
            wrong = wrong or _first_without_meaning(rays, first)
            other = other or media_rays.first_other_ratio(found.header, rays.k, first)
    _check_rays(path, same and kept.checksum == found.header["checksum"], wrong, other)
    return kept.rays


def _check_header(path: Path, header: Header, rays: int) -> None:
    if header.get("format") != FORMAT:
        raise ValueError(f"{path}: not a file of rays; accepted: what `mi-refract rays export` writes ({FORMAT})")
    try:
        headers.check(header, rays)
        media_rays.check(header)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _check_rays(path: Path, same: bool, wrong: str, other: str) -> None:
    if not same:
        found = "the checksum does not match, so it was edited or cut short"
        raise ValueError(f"{path}: {found}; accepted: the file as it was exported")
    if wrong:
        raise ValueError(f"{path}: {wrong}; accepted: finite vectors that are not zero, finite indices above 0")
    if other:
        raise ValueError(f"{path}: {other}")


def _ray_set(header: Header, numbers: np.ndarray) -> RaySet:
    ids = np.arange(len(numbers))
    return RaySet(_rays(header, numbers), ids, regime_names(header, len(ids)), header)


def _rays(header: Header, numbers: np.ndarray) -> Rays:
    precision = PRECISIONS[header["precision"]]
    with np.errstate(all="ignore"):
        a, n, k = numbers[:, 1:4], numbers[:, 4:7], numbers[:, 7] / numbers[:, 8]
        return Rays(*(x.astype(precision) for x in (a, n, k)))


def _first_without_meaning(rays: Rays, first: int = 0) -> str:
    """Of the rays that have no refraction, the first; "" where there is none. `first`: the id of the first ray."""
    a, n, k = rays.a, rays.n, rays.k
    good = np.isfinite(a).all(1) & np.isfinite(n).all(1) & a.any(1) & n.any(1) & np.isfinite(k) & (k > 0)
    return "" if good.all() else f"ray {first + np.argmin(good)} is none"


def read_answers(path: str | Path, *, most: int = MOST_RAYS) -> Answers:
    """The answers in a file, in memory: `most` at most.

    ValueError, one line, where it holds none, or more. OSError where it cannot be read.
    """
    path = _with_known_suffix(path)
    return _answers(str(path), *_read(path, ANSWER_ARRAYS, ANSWER_COLUMNS, TRANSMITTED, N_RATIO, most=most))


def read_stored_answers(path: str | Path, rays: Sized) -> StoredAnswers:
    """The answers to stored rays in a file, outside of the memory. Errors as of `read_answers`."""
    path = _with_known_suffix(path)
    with _opened(path, ANSWER_ARRAYS, ANSWER_COLUMNS, (TRANSMITTED, N_RATIO), most_answers(rays)) as found:
        rows = _answer_rows(str(path), found.pieces(STEP), found.names)
        flagged, with_ratio = (name in found.names for name in (TRANSMITTED, N_RATIO))
        return stored_answers.match(found.header, rows, len(rays), flagged, with_ratio)


def parse_answers(text: str | bytes, name: str = "answers") -> Answers:
    """The answers in the text of a CSV file. ValueError, one line that begins with `name`, where it holds none."""
    return _answers(name, *parse_table(name, text, ANSWER_COLUMNS, TRANSMITTED, N_RATIO))


def most_answers(rays: Sized) -> int:
    """The most rows that answers to these rays may have: twice as many, and some for small sets."""
    return 2 * len(rays) + 100


def csv_bytes(rows: int) -> int:
    """The largest size of CSV text with so many rows, in memory."""
    return min(rows * _ROW_BYTES + _TOP_BYTES, _CSV_BYTES)


def _with_known_suffix(path: str | Path) -> Path:
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: accepted: a file name that ends in {' or '.join(SUFFIXES)}")
    return path


def _answers(name: str, header: Header, numbers: np.ndarray, names: Sequence[str]) -> Answers:
    [(ids, b, flags, n_ratio)] = _answer_rows(name, [numbers], names)
    return Answers(ids, b, flags, header, n_ratio)


def _answer_rows(name: str, pieces: Iterable[np.ndarray], names: Sequence[str]) -> Iterator[stored_answers.Rows]:
    """Ids, b and the optional columns of pieces (n, 4 to 6). ValueError at their end, where any is none."""
    wrong_ids, wrong_flags, wrong_ratios = _Wrong(), _Wrong(), _Wrong()
    for numbers in pieces:
        ids = numbers[:, 0]
        flags, n_ratio = (numbers[:, names.index(each)] if each in names else None for each in (TRANSMITTED, N_RATIO))
        wrong_ids = wrong_ids.with_more(ids[~(np.abs(ids) < 2**53) | (np.rint(ids) != ids)])
        if flags is not None:
            wrong_flags = wrong_flags.with_more(flags[~np.isin(flags, (0, 1))])
        if n_ratio is not None:
            wrong_ratios = wrong_ratios.with_more(n_ratio[~((n_ratio >= LEAST_RATIO) & (n_ratio <= 1 / LEAST_RATIO))])
        if not wrong_ids.count and not wrong_flags.count and not wrong_ratios.count:
            yield ids.astype(np.int64), numbers[:, 1:4], None if flags is None else flags == 1, n_ratio
    if wrong_ids.count:
        found = f"{wrong_ids.count} ids are not whole numbers below 2^53, the first is {wrong_ids.first:g}"
        raise ValueError(f"{name}: {found}; accepted: the ids of the rays")
    if wrong_flags.count:
        found = f"{TRANSMITTED} is {wrong_flags.first} for {wrong_flags.count} rays"
        raise ValueError(f"{name}: {found}; accepted: 0 or 1")
    if wrong_ratios.count:
        found = f"{N_RATIO} is {wrong_ratios.first:g} for {wrong_ratios.count} rays"
        raise ValueError(f"{name}: {found}; accepted: n_from / n_to, {LEAST_RATIO:g} … {1 / LEAST_RATIO:g}")


@dataclass(frozen=True)
class _Wrong:
    """How many numbers are wrong, and the first of them."""

    count: int = 0
    first: float = 0.0

    def with_more(self, wrong: np.ndarray) -> _Wrong:
        return (
            self if not len(wrong) else _Wrong(self.count + len(wrong), self.first if self.count else float(wrong[0]))
        )


def _read(
    path: Path, arrays: dict[str, int], columns: Sequence[str], *optional: str, most: int
) -> tuple[Header, np.ndarray, tuple[str, ...]]:
    """(header, (N, columns) float64, their names) of any format, N up to `most`.

    `arrays`: the arrays of an .npz file and their widths.
    """
    header, numbers, names = _read_any(path, arrays, columns, optional, most)
    if len(numbers) > most:
        raise ValueError(f"{path}: {len(numbers)} rows; accepted: up to {most}")
    return header, numbers, names


def _read_any(
    path: Path, arrays: dict[str, int], columns: Sequence[str], optional: Sequence[str], most: int
) -> tuple[Header, np.ndarray, tuple[str, ...]]:
    if path.suffix.lower() == ".csv":
        return parse_table(str(path), regular_file.read_bytes(path, csv_bytes(most)), columns, *optional)
    if path.suffix.lower() == ".npz":
        text, numbers, found = npz_arrays.read(path, {"id": 1, **arrays}, csv_table.flat(optional), most)
        return _header(text), numbers, _names(columns, optional, found)
    return _read_image(path, columns, optional)


def _read_image(
    path: Path, columns: Sequence[str], optional: Sequence[str]
) -> tuple[Header, np.ndarray, tuple[str, ...]]:
    image = image_file.read(path)
    chosen = _names(columns, optional, image.channels)
    pixels = image.select(chosen).reshape(-1, len(chosen)).astype(np.float64)
    return _header(image.metadata.get(_ATTRIBUTE, "")), pixels[pixels[:, 0] != -1], chosen


def _names(columns: Sequence[str], optional: Sequence[str], found: Collection[str]) -> tuple[str, ...]:
    """Those of the columns, with the optional ones that are found."""
    return (*columns, *(name for name in csv_table.flat(optional) if name in found))


@dataclass(frozen=True)
class _Opened:
    """What a file holds: the header, and (rows, columns) float64 in pieces of so many rows, with the columns' names."""

    header: Header
    rows: int
    names: Sequence[str]
    pieces: Callable[[int], Iterator[np.ndarray]]


@contextlib.contextmanager
def _opened(
    path: Path, arrays: dict[str, int], columns: Sequence[str], optional: Sequence[str], most: int
) -> Iterator[_Opened]:
    """As `_read`, of which only a piece is in memory; of EXR, whose rows are few, all."""
    if path.suffix.lower() == ".csv":
        limit = most * _ROW_BYTES + _TOP_BYTES
        with regular_file.opened(path, limit) as stream:
            header, log, names = read_table(str(path), stream, columns, optional, most, limit)
        yield _Opened(header, log.rows, names, log.pieces)
    elif path.suffix.lower() == ".npz":
        with npz_arrays.opened(path, {"id": 1, **arrays}, csv_table.flat(optional), most) as found:
            yield _Opened(_header(found.text), found.rows, _names(columns, optional, found.names), found.pieces)
    else:
        header, numbers, names = _read(path, arrays, columns, *optional, most=most)
        parts = lambda step: (numbers[i : i + step] for i in range(0, len(numbers), step))  # noqa: E731
        yield _Opened(header, len(numbers), names, parts)


def _header(text: Any) -> Header:
    """The header in JSON text, empty where there is none."""
    try:
        header = headers.as_json(text) if isinstance(text, str) else {}
    except ValueError:
        return {}
    return header if isinstance(header, dict) else {}
