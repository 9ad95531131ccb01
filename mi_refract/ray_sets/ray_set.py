"""Ray sets in files: incident rays for other people's refraction, and the answers they give back.

A set is one or several regimes of `regimes`, rounded to float32 or float64. The same regimes, count, precision and
seed give the same file, byte for byte. The ratio n_from / n_to is exact: n_to is a power of two, 1 where it can be,
and no index is below 1. So whoever divides them, in whatever precision, has the k that is asked for.

    rays      .csv: id, ax, ay, az, nx, ny, nz, n_from, n_to   .npz: id, a, n, n_from, n_to   .exr: one pixel a ray
    answers   .csv: id, bx, by, bz[, transmitted]              .npz: id, b[, transmitted]     .exr: channels as in .csv

Numbers in CSV are the shortest decimals that float64 reads as these very numbers; so does float32, then.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract import regimes
from mi_refract.io import image_file
from mi_refract.io.atomic import writable, write_atomically
from mi_refract.numerics import float_expansions
from mi_refract.regimes import Rays

from .csv_table import table, with_header

FORMAT = "mi_refract rays 1"
SUFFIXES = (".csv", ".npz", ".exr")
PRECISIONS: dict[str, Any] = {"f32": np.float32, "f64": np.float64}
COLUMNS = ("id", "ax", "ay", "az", "nx", "ny", "nz", "n_from", "n_to")
ANSWER_COLUMNS = ("id", "bx", "by", "bz")
FLAG = "transmitted"
# Vectors are unit there, up to the rounding of their components, as documented formulas demand.
DEFAULT = tuple(name for name, regime in regimes.REGIMES.items() if regime.unit and not regime.rests_on_denormals)
COUNT, PRECISION = 1000, "f32"
CONVENTIONS = {
    "a": "incident direction, pointing toward the surface",
    "n": "normal, on the side that the ray comes from: n.a <= 0",
    "n, two-sided": "normal, on either side of the surface",
    "n_from, n_to": "indices of the media that the ray leaves and enters; k = n_from / n_to is exact",
    "answer": "id, bx, by, bz: the direction after the surface; optionally transmitted: 1, or 0 where all is reflected",
}
_EXR_WIDTH = 1024
_EXR_IDS = 2**24  # float32 knows whole numbers up to here
_ATTRIBUTE = "mi_refract:rays"


def indices(k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n_from, n_to), each (N,) and at least 1; their ratio is k, exactly."""
    _, exponent = np.frexp(k)
    n_to = np.ldexp(np.ones_like(k), np.maximum(1 - exponent, 0))
    return k * n_to, n_to


@dataclass(frozen=True)
class RaySet:
    """Rays with their ids (N,), the name of the regime of each (N,), and what the file says of them all."""

    rays: Rays
    ids: np.ndarray
    regime: np.ndarray
    header: dict[str, Any]

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def precision(self) -> str:
        """ "f32" or "f64": of the numbers, and what an answer to them claims."""
        return str(self.header["precision"])

    @property
    def roundoff(self) -> float:
        """Half an ulp of 1 in the set's precision."""
        return float(np.finfo(PRECISIONS[self.precision]).eps) / 2

    @property
    def indices(self) -> tuple[np.ndarray, np.ndarray]:
        """`indices` of the rays' k."""
        return indices(self.rays.k)

    @property
    def numbers(self) -> np.ndarray:
        """(N, 9) float64, the columns of a CSV file."""
        return np.column_stack([self.ids, self.rays.a, self.rays.n, *self.indices]).astype(np.float64)


@dataclass(frozen=True)
class Answers:
    """What came back: ids (N,), b (N, 3) float64, the column `transmitted` (N,) if there is one, and the `#` lines."""

    ids: np.ndarray
    b: np.ndarray
    transmitted: np.ndarray | None = None
    header: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        flags = () if self.transmitted is None else (self.transmitted.shape,)
        if self.b.shape != (len(self.ids), 3) or any(shape != self.ids.shape for shape in flags):
            raise ValueError(f"answers: b is {self.b.shape} for {len(self.ids)} ids; accepted: a direction for each id")


def make(
    names: Iterable[str] = DEFAULT,
    count: int = COUNT,
    precision: str = PRECISION,
    seed: int = 0,
    *,
    two_sided: bool = False,
) -> RaySet:
    """`count` rays of each of these regimes. Normals face the ray unless `two_sided`.

    ValueError for a regime or a precision that is not there, a regime given twice, or no ray at all.
    """
    names = tuple(names)
    if unknown := [name for name in names if name not in regimes.REGIMES]:
        raise ValueError(f"regime {unknown[0]!r}: unknown; accepted: {', '.join(map(repr, regimes.REGIMES))}")
    if precision not in PRECISIONS:
        raise ValueError(f"precision {precision!r}: unknown; accepted: {', '.join(PRECISIONS)}")
    if not names or len(set(names)) < len(names) or count < 1 or seed < 0:
        raise ValueError(f"{count} rays of {list(names)}, seed {seed}: accepted: at least one ray, each regime once")
    rays = Rays.joined([regimes.make(name, count, PRECISIONS[precision], seed) for name in names])
    if not two_sided:
        rays = _facing(rays)
    header = _header(names, count, precision, seed, two_sided)
    return _checked(RaySet(rays, np.arange(len(rays)), _names(header, len(rays)), header))


def _facing(rays: Rays) -> Rays:
    """The same rays, each with its normal on the side it comes from."""
    c = float_expansions.dot(rays.n.T.astype(np.float64), rays.a.T.astype(np.float64))[0]
    return Rays(rays.a, np.where(c[:, None] > 0, -rays.n, rays.n), rays.k)


def _header(names: Sequence[str], count: int, precision: str, seed: int, two_sided: bool) -> dict[str, Any]:
    from mi_refract import __version__

    conventions = {key: text for key, text in CONVENTIONS.items() if key not in ("n", "n, two-sided")}
    conventions["n"] = CONVENTIONS["n, two-sided" if two_sided else "n"]
    ids = {name: [i * count, (i + 1) * count - 1] for i, name in enumerate(names)}
    return {
        "format": FORMAT,
        "version": __version__,
        "precision": precision,
        "seed": seed,
        "count": count,
        "two_sided": two_sided,
        **conventions,
        "regimes": ids,
    }


def _names(header: dict[str, Any], count: int) -> np.ndarray:
    """The regime of every ray, by the ranges of ids in the header."""
    names = np.full(count, "", dtype=object)
    for name, (first, last) in header["regimes"].items():
        names[first : last + 1] = name
    return names


def _checked(rays: RaySet) -> RaySet:
    return RaySet(rays.rays, rays.ids, rays.regime, rays.header | {"checksum": checksum(rays)})


def checksum(rays: RaySet) -> str:
    """Of the header but for its own line, and of the numbers; the same for every file format."""
    told = {key: value for key, value in rays.header.items() if key != "checksum"}
    digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
    digest.update(rays.numbers.astype("<f8").tobytes())
    return f"sha256:{digest.hexdigest()}"


def remake(header: dict[str, Any]) -> RaySet:
    """The set that a header describes. ValueError where this version makes other rays of it, or it describes none."""
    try:
        names, count, precision, seed = (header[key] for key in ("regimes", "count", "precision", "seed"))
        rays = make(names, count, precision, seed, two_sided=header["two_sided"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"the answers' header describes no rays ({error!r}); accepted: that of the rays") from None
    if rays.header["checksum"] != header.get("checksum"):
        raise ValueError("the answers are to rays that this version cannot make again; accepted: with --rays FILE")
    return rays


# Writing ---------------------------------------------------------------------------------------------------------


def write(path: str | Path, rays: RaySet) -> Path:
    """Write .csv, .npz or .exr, complete or not at all.

    ValueError for another ending, or what the format cannot hold: EXR has float32, and ids up to 2²⁴. OSError.
    """
    path = writable(path, SUFFIXES)
    if path.suffix.lower() == ".exr":
        _write_exr(path, rays)
    else:
        write_atomically(path, as_csv(rays) if path.suffix.lower() == ".csv" else _as_npz(rays))
    return path


def as_csv(rays: RaySet) -> str:
    return with_header(rays.header, COLUMNS, rays.numbers)


def _as_npz(rays: RaySet) -> bytes:
    n_from, n_to = rays.indices
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
            # An entry of its own making has no time of day in it.
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
    return buffer.getvalue()


def _write_exr(path: Path, rays: RaySet) -> None:
    """Rays row by row, as many pixels wide as there are up to 1024; what is left of the last row has the id −1."""
    if rays.precision != "f32" or len(rays) > _EXR_IDS:
        raise ValueError(f"{path}: {len(rays)} rays in {rays.precision}; accepted in EXR: f32, up to {_EXR_IDS}")
    width = min(len(rays), _EXR_WIDTH)
    height = -(-len(rays) // width)
    pixels = np.zeros((height * width, len(COLUMNS)), np.float32)
    pixels[len(rays) :, 0] = -1
    pixels[: len(rays)] = rays.numbers
    # Without a date OpenImageIO writes today's.
    metadata = {_ATTRIBUTE: json.dumps(rays.header), "DateTime": "1970:01:01 00:00:00"}
    image_file.write_exr(path, pixels.reshape(height, width, -1), COLUMNS, metadata)


# Reading ---------------------------------------------------------------------------------------------------------


def read(path: str | Path) -> RaySet:
    """A file of rays that nobody has changed.

    ValueError, one line: another format, a header that is missing, a number that is none, a checksum that does not
    fit, as in a file that was edited or cut short. OSError.
    """
    path = _known(path)
    header, numbers = _read(path, {"a": 3, "n": 3, "n_from": 1, "n_to": 1}, COLUMNS)
    if header.get("format") != FORMAT:
        raise ValueError(f"{path}: not a file of rays; accepted: what `mi-refract rays export` writes ({FORMAT})")
    try:
        precision = PRECISIONS[header["precision"]]
        with np.errstate(all="ignore"):
            a, n, k = numbers[:, 1:4], numbers[:, 4:7], numbers[:, 7] / numbers[:, 8]
            found = Rays(*(x.astype(precision) for x in (a, n, k)))
            ids = numbers[:, 0].astype(np.int64)
        rays = RaySet(found, ids, _names(header, len(ids)), header)
        intact = checksum(rays) == header["checksum"] and np.array_equal(rays.numbers, numbers)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: broken header ({error!r}); accepted: the file as it was exported") from None
    if not intact:
        raise ValueError(f"{path}: the checksum does not fit: it was edited or cut short; accepted: as it was exported")
    return rays


def read_answers(path: str | Path) -> Answers:
    """A file of answers. ValueError, one line, for what cannot be read as one; OSError."""
    path = _known(path)
    return _answers(str(path), *_read(path, {"b": 3, FLAG: 1}, ANSWER_COLUMNS, FLAG))


def parse_answers(text: str | bytes, name: str = "answers") -> Answers:
    """The same of the text of a CSV file."""
    return _answers(name, *table(name, text, ANSWER_COLUMNS, FLAG))


def _known(path: str | Path) -> Path:
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: accepted: a file name that ends in {' or '.join(SUFFIXES)}")
    return path


def _answers(name: str, header: dict[str, Any], numbers: np.ndarray) -> Answers:
    ids = numbers[:, 0]
    if (wrong := ~(np.abs(ids) < 2**53) | (np.rint(ids) != ids)).any():
        found = f"{wrong.sum()}, {ids[wrong][0]:g} first"
        raise ValueError(f"{name}: ids that no ray can have: {found}; accepted: the rays'")
    flags = numbers[:, 4] if numbers.shape[1] > 4 else None
    if flags is not None and (wrong := ~np.isin(flags, (0, 1))).any():
        raise ValueError(f"{name}: {FLAG} is {flags[wrong][0]} of {wrong.sum()} rays; accepted: 0 or 1")
    return Answers(ids.astype(np.int64), numbers[:, 1:4], None if flags is None else flags == 1, header)


def _read(path: Path, arrays: dict[str, int], columns: Sequence[str], *more: str) -> tuple[dict[str, Any], np.ndarray]:
    """(header, (N, columns) float64) of any format; `more` may be missing."""
    if path.suffix.lower() == ".csv":
        return table(str(path), path.read_bytes(), columns, *more)
    if path.suffix.lower() == ".npz":
        return _read_npz(path, arrays, more)
    image = image_file.read(path)
    chosen = [*columns, *(name for name in more if name in image.channels)]
    pixels = image.select(chosen).reshape(-1, len(chosen)).astype(np.float64)
    return _json(image.metadata.get(_ATTRIBUTE, "{}")), pixels[pixels[:, 0] != -1]


def _read_npz(path: Path, arrays: dict[str, int], more: Sequence[str]) -> tuple[dict[str, Any], np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
        parts = {name: found[name] for name in ("id", *arrays) if name in found or name not in more}
        count = len(parts["id"])
        numbers = [x.reshape(count, {"id": 1, **arrays}[name]).astype(np.float64) for name, x in parts.items()]
    except (KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        accepted = ", ".join(name for name in ("id", *arrays) if name not in more)
        raise ValueError(f"{path}: {image_file.one_line(str(error))}; accepted: an .npz file with {accepted}") from None
    return _json(str(found.get("header", "{}"))), np.hstack(numbers)


def _json(text: str) -> dict[str, Any]:
    try:
        header = json.loads(text)
    except ValueError:
        return {}
    return header if isinstance(header, dict) else {}
