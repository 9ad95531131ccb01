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

import numpy as np

from mi_refract.io import image_file
from mi_refract.io.atomic import writable, write_atomically
from mi_refract.regimes import Rays

from .csv_table import parse_table, with_header
from .ray_set import FORMAT, PRECISIONS, Answers, Header, RaySet, checksum, indices, regime_names

SUFFIXES = (".csv", ".npz", ".exr")
COLUMNS = ("id", "ax", "ay", "az", "nx", "ny", "nz", "n_from", "n_to")
ANSWER_COLUMNS = ("id", "bx", "by", "bz")
TRANSMITTED = "transmitted"  # the optional column of answers
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
    header, numbers = _read(path, {"a": 3, "n": 3, "n_from": 1, "n_to": 1}, COLUMNS)
    if header.get("format") != FORMAT:
        raise ValueError(f"{path}: not a file of rays; accepted: what `mi-refract rays export` writes ({FORMAT})")
    try:
        rays = _ray_set(header, numbers)
        intact = checksum(rays) == header["checksum"] and np.array_equal(rays.numbers, numbers)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: broken header ({error!r}); accepted: the file as it was exported") from None
    if not intact:
        found = "the checksum does not match, so it was edited or cut short"
        raise ValueError(f"{path}: {found}; accepted: the file as it was exported")
    return rays


def _ray_set(header: Header, numbers: np.ndarray) -> RaySet:
    precision = PRECISIONS[header["precision"]]
    with np.errstate(all="ignore"):
        a, n, k = numbers[:, 1:4], numbers[:, 4:7], numbers[:, 7] / numbers[:, 8]
        rays = Rays(*(x.astype(precision) for x in (a, n, k)))
        ids = numbers[:, 0].astype(np.int64)
    return RaySet(rays, ids, regime_names(header, len(ids)), header)


def read_answers(path: str | Path) -> Answers:
    """The answers in a file. ValueError, one line, where it holds none. OSError where it cannot be read."""
    path = _with_known_suffix(path)
    return _answers(str(path), *_read(path, {"b": 3, TRANSMITTED: 1}, ANSWER_COLUMNS, TRANSMITTED))


def parse_answers(text: str | bytes, name: str = "answers") -> Answers:
    """The answers in the text of a CSV file. ValueError, one line that begins with `name`, where it holds none."""
    return _answers(name, *parse_table(name, text, ANSWER_COLUMNS, TRANSMITTED))


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


def _read(path: Path, arrays: dict[str, int], columns: Sequence[str], *optional: str) -> tuple[Header, np.ndarray]:
    """(header, (N, columns) float64) of any format. `arrays`: the arrays of an .npz file and their widths."""
    if path.suffix.lower() == ".csv":
        return parse_table(str(path), path.read_bytes(), columns, *optional)
    if path.suffix.lower() == ".npz":
        return _read_npz(path, arrays, optional)
    image = image_file.read(path)
    chosen = [*columns, *(name for name in optional if name in image.channels)]
    pixels = image.select(chosen).reshape(-1, len(chosen)).astype(np.float64)
    return _header(image.metadata.get(_ATTRIBUTE, "{}")), pixels[pixels[:, 0] != -1]


def _read_npz(path: Path, arrays: dict[str, int], optional: Sequence[str]) -> tuple[Header, np.ndarray]:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:  # a bad file is closed, too
            found = {name: file[name] for name in file.files}
        parts = {name: found[name] for name in ("id", *arrays) if name in found or name not in optional}
        count = len(parts["id"])
        numbers = [x.reshape(count, {"id": 1, **arrays}[name]).astype(np.float64) for name, x in parts.items()]
    except (KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        accepted = ", ".join(name for name in ("id", *arrays) if name not in optional)
        raise ValueError(f"{path}: {image_file.one_line(str(error))}; accepted: an .npz file with {accepted}") from None
    return _header(str(found.get("header", "{}"))), np.hstack(numbers)


def _header(text: str) -> Header:
    """The header in JSON text, empty where there is none."""
    try:
        header = json.loads(text)
    except ValueError:
        return {}
    return header if isinstance(header, dict) else {}
