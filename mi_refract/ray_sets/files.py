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
from collections.abc import Sized
from pathlib import Path

import numpy as np

from mi_refract.io import image_file
from mi_refract.io.atomic import writable, write_atomically
from mi_refract.io.image_file import one_line
from mi_refract.regimes import Rays

from . import header as headers
from . import media_rays, tables
from .header import FORMAT, PRECISIONS, Header
from .ray_set import Answers, RaySet, checksum, indices
from .tables import SUFFIXES, Table

COLUMNS = ("id", "ax", "ay", "az", "nx", "ny", "nz", "n_from", "n_to")
RAY_LAYOUTS = (COLUMNS, (*COLUMNS, *media_rays.COLUMNS))
ANSWER_COLUMNS = ("id", "bx", "by", "bz")
TRANSMITTED, N_RATIO = "transmitted", "n_ratio"
ANSWER_LAYOUTS = tuple((*ANSWER_COLUMNS, *more) for more in ((), (TRANSMITTED,), (N_RATIO,), (TRANSMITTED, N_RATIO)))
LEAST_RATIO = 1e-9  # of answers: a thousandth of the least in any set
MOST_RAYS = 2**28 // len(COLUMNS)  # 3e7: their numbers take 2 GiB, and checking them takes 8 GB
MOST_EXR_RAYS = 2**24  # float32 holds all ids up to this one
_EXR_WIDTH = 1024


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
    columns = RAY_LAYOUTS[media_rays.has_media(rays.header)]
    return tables.csv_text(rays.header, columns, rays.numbers, whole=media_rays.WHOLE)


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
    """One pixel per ray, row by row, at most 1024 pixels wide."""
    if rays.precision != "f32" or len(rays) > MOST_EXR_RAYS:
        raise ValueError(
            f"{path}: {len(rays)} rays in {rays.precision}; EXR holds f32 only, and up to {MOST_EXR_RAYS} rays"
        )
    width = min(len(rays), _EXR_WIDTH)
    height = -(-len(rays) // width)
    columns = RAY_LAYOUTS[media_rays.has_media(rays.header)]
    pixels = np.zeros((height * width, len(columns)), np.float32)
    pixels[len(rays) :, 0] = tables.EXR_UNUSED
    pixels[: len(rays)] = rays.numbers
    metadata = {tables.EXR_HEADER: json.dumps(rays.header), **image_file.NO_DATE}
    image_file.write_exr(path, pixels.reshape(height, width, -1), columns, metadata)


def read(path: str | Path) -> RaySet:
    """The rays of a file that is as `write` left it.

    ValueError, one line, for another format, more than MOST_RAYS, a missing header, a cell that is not a number, or a
    checksum that does not match (a file that was edited or cut short). OSError where the file cannot be read.
    """
    path = Path(path)
    table = tables.read(path, RAY_LAYOUTS, MOST_RAYS)
    try:
        return _rays(table)
    except ValueError as error:
        raise ValueError(f"{path}: {one_line(str(error))}") from None


def _rays(table: Table) -> RaySet:
    header, numbers = table.header, table.numbers
    if header.get("format") != FORMAT:
        raise ValueError(f"not a file of rays; expected what `mi-refract rays export` writes ({FORMAT})")
    headers.check(header, len(numbers))
    media_rays.check(header)
    with np.errstate(all="ignore"):
        parts = numbers[:, 1:4], numbers[:, 4:7], numbers[:, 7] / numbers[:, 8]
        a, n, k = (x.astype(PRECISIONS[header["precision"]]) for x in parts)
    rays = RaySet(Rays(a, n, k), np.arange(len(numbers)), header)
    # Equal numbers first: a file may hold digits that are lost in the set's precision.
    if not np.array_equal(rays.numbers, numbers) or checksum(header, numbers) != header["checksum"]:
        raise ValueError("the checksum does not match: the file was edited or cut short; expected it as exported")
    valid = np.isfinite(a).all(1) & np.isfinite(n).all(1) & a.any(1) & n.any(1) & np.isfinite(k) & (k > 0)
    if not valid.all():
        raise ValueError(f"ray {np.argmin(valid)} is invalid: zero or non-finite vector, or index ≤ 0")
    media_rays.check_ratios(header, k)
    return rays


def read_answers(path: str | Path, *, most: int = MOST_RAYS) -> Answers:
    """The answers in a file, `most` at most.

    ValueError, one line, where it holds none, or more. OSError where it cannot be read.
    """
    return _answers(str(path), tables.read(Path(path), ANSWER_LAYOUTS, most))


def parse_answers(text: str | bytes, name: str = "answers") -> Answers:
    """The answers in the text of a CSV file. ValueError, one line that begins with `name`, where it holds none."""
    stream = io.BytesIO(text.encode() if isinstance(text, str) else text)
    return _answers(name, tables.read_csv(name, stream, ANSWER_LAYOUTS, MOST_RAYS))


def most_answers(rays: Sized) -> int:
    """The most rows that answers to these rays may have: twice as many, and some for small sets."""
    return 2 * len(rays) + 100


def _answers(name: str, table: Table) -> Answers:
    header: Header = table.header
    columns = dict(zip(table.columns, table.numbers.T, strict=True))
    ids, transmitted, ratios = columns["id"], columns.get(TRANSMITTED), columns.get(N_RATIO)
    if len(wrong := ids[~(np.abs(ids) < 2**53) | (np.rint(ids) != ids)]):
        found = f"{len(wrong)} ids are not whole numbers below 2^53, the first is {wrong[0]:g}"
        raise ValueError(f"{name}: {found}; expected the ids of the rays")
    if transmitted is not None and len(wrong := transmitted[~np.isin(transmitted, (0, 1))]):
        raise ValueError(f"{name}: {TRANSMITTED} is {wrong[0]} for {len(wrong)} rays; expected 0 or 1")
    if ratios is not None and len(wrong := ratios[~((ratios >= LEAST_RATIO) & (ratios <= 1 / LEAST_RATIO))]):
        found = f"{N_RATIO} is {wrong[0]:g} for {len(wrong)} rays"
        raise ValueError(f"{name}: {found}; expected n_from / n_to, {LEAST_RATIO:g} … {1 / LEAST_RATIO:g}")
    return Answers(ids.astype(np.int64), table.numbers[:, 1:4], transmitted, header, ratios)
