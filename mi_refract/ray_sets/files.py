"""Files of rays and of answers, in CSV and NumPy's .npz; and programs that read rays and print answers.

    rays      .csv: id, ax, ay, az, nx, ny, nz, n_from, n_to   .npz: id, a, n, n_from, n_to
    answers   .csv: id, bx, by, bz[, transmitted][, n_ratio]   .npz: id, b[, …]

Rays with media have two more columns or arrays: wavelength, medium. The header is in lines `# key: value` on top of a
CSV file, and JSON text in the array `header` of an .npz file.

A number in CSV is the shortest decimal that reads back, in float64, as exactly that number; a float32 number also reads
back exactly in float32.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import shlex
import tokenize
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from mi_refract.io import process_group, safe_files
from mi_refract.io.errors import TooMuchOutputError
from mi_refract.io.image_file import one_line
from mi_refract.io.safe_files import writable, write_atomically
from mi_refract.regimes import Array, Rays

from . import header as headers
from .header import FORMAT, PRECISIONS, Header
from .ray_set import MOST_RAYS, Answers, RaySet, checksum, indices

SUFFIXES = (".csv", ".npz")
COLUMNS = ("id", "ax", "ay", "az", "nx", "ny", "nz", "n_from", "n_to")
RAY_LAYOUTS = (COLUMNS, (*COLUMNS, *headers.COLUMNS))
ANSWER_COLUMNS = ("id", "bx", "by", "bz")
TRANSMITTED, N_RATIO = "transmitted", "n_ratio"
ANSWER_LAYOUTS = tuple((*ANSWER_COLUMNS, *more) for more in ((), (TRANSMITTED,), (N_RATIO,), (TRANSMITTED, N_RATIO)))
LEAST_RATIO = 1e-9  # smallest `n_ratio` of an answer: a thousandth of the smallest ratio in any set
TIMEOUT = 300.0  # seconds for a program
# The names of the columns, in order. In an .npz file, `ax`, `ay`, `az` are one array `a` of shape (N, 3).
Layout = tuple[str, ...]
T = TypeVar("T")

# Visual C++ and others print NaN as nan(ind) or similar; C allows letters, digits and _ between the brackets.
_NAN = re.compile(r"nan\([A-Za-z0-9_]{0,32}\)", re.IGNORECASE)
_LONGEST_LINE = 2**20  # characters
_ROW_BYTES, _TOP_BYTES = 1024, 2**20  # limits of CSV: a row, five times what its digits need; the header
_TEXT_BYTES = 2**32  # limit of CSV text in memory
_NUMBER_BYTES = 16  # size of a `longdouble`
_ARRAY_TOP_BYTES = 2**14  # NumPy describes an array in at most 10,000 bytes
_NPZ_HEADER_BYTES = 2**20
_NPZ_MORE_BYTES = 2**24  # limit of all other content of an .npz file
_NPZ_ERRORS = (
    *(zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, EOFError),
    *(RuntimeError, TypeError, ValueError, OverflowError, MemoryError),
    *(SyntaxError, tokenize.TokenError),  # of NumPy's parser
)


# Rays --------------------------------------------------------------------------------------------------------------


def write(path: str | Path, rays: RaySet) -> Path:
    """Write a .csv or .npz file, completely or not at all. ValueError for another suffix; OSError if writing fails."""
    path = writable(path, SUFFIXES)
    if path.suffix.lower() == ".csv":
        write_atomically(path, as_csv(rays))
        return path
    n_from, n_to = indices(rays.rays.k)
    arrays = {"id": rays.ids, "a": rays.rays.a, "n": rays.rays.n, "n_from": n_from, "n_to": n_to}
    if headers.has_media(rays.header):
        wavelength, medium = headers.columns(rays.header, rays.ids).T
        arrays |= {"wavelength": wavelength.astype(rays.rays.k.dtype), "medium": medium.astype(np.int64)}
    write_atomically(path, npz({**arrays, "header": np.array(json.dumps(rays.header))}))
    return path


def npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """An .npz file of these arrays by name. The same arrays give the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in arrays.items():
            # A ZipInfo without a date has a fixed one.
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
    return buffer.getvalue()


def as_csv(rays: RaySet) -> str:
    """The text of a CSV file of the rays."""
    columns, header = RAY_LAYOUTS[headers.has_media(rays.header)], rays.header
    top = [f"# {key}: {value if value == _value(value) else json.dumps(value)}" for key, value in header.items()]
    row = ",".join("%d" if name in ("id", "medium") else "%r" for name in columns)
    return "\n".join([*top, ",".join(columns), *(row % tuple(x) for x in rays.numbers.tolist()), ""])


def read(path: str | Path) -> RaySet:
    """The rays of a file that `write` wrote.

    ValueError, one line, for another format, more than MOST_RAYS rays, a missing header, a cell that is not a number,
    or a checksum that does not match (the file was edited or cut short). OSError if the file cannot be read.
    """
    return _read(Path(path), RAY_LAYOUTS, MOST_RAYS, _rays)


def _rays(table: Table) -> RaySet:
    header, numbers = table.header, table.numbers
    if header.get("format") != FORMAT:
        raise ValueError(f"not a file of rays; expected one that `mi-refract rays export` wrote ({FORMAT})")
    headers.check(header, len(numbers))
    with np.errstate(all="ignore"):
        vectors_and_ratio = numbers[:, 1:4], numbers[:, 4:7], numbers[:, 7] / numbers[:, 8]
        a, n, k = (x.astype(PRECISIONS[header["precision"]]) for x in vectors_and_ratio)
    rays = RaySet(Rays(a, n, k), np.arange(len(numbers)), header)
    # Compare the numbers too: a file may contain digits that are lost in the set's precision.
    if not np.array_equal(rays.numbers, numbers) or checksum(header, numbers) != header["checksum"]:
        raise ValueError("the checksum does not match: the file was edited or cut short; expected the file as exported")
    valid = np.isfinite(a).all(1) & np.isfinite(n).all(1) & a.any(1) & n.any(1) & np.isfinite(k) & (k > 0)
    if not valid.all():
        raise ValueError(f"ray {np.argmin(valid)} is invalid: zero or non-finite vector, or index ≤ 0")
    headers.check_ratios(header, k)
    return rays


# Answers -----------------------------------------------------------------------------------------------------------


def read_answers(path: str | Path, *, most: int = MOST_RAYS) -> Answers:
    """The answers in a file, at most `most`.

    ValueError, one line, for a file that is not a table of answers, or has more. OSError if it cannot be read.
    """
    return _read(Path(path), ANSWER_LAYOUTS, most, _answers)


def parse_answers(text: str | bytes, name: str = "answers") -> Answers:
    """The answers in the text of a CSV file. ValueError, one line that begins with `name`, for any other text."""
    content = text.encode() if isinstance(text, str) else text
    try:
        table = _read_csv(io.BytesIO(content), ANSWER_LAYOUTS, MOST_RAYS)
        return _answers(table._replace(digest=hashlib.sha256(content).hexdigest()))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def most_answers(rays: Sized) -> int:
    """The largest number of rows that answers to these rays may have: twice as many as rays, plus 100."""
    return 2 * len(rays) + 100


def _answers(table: Table) -> Answers:
    columns = dict(zip(table.columns, table.numbers.T, strict=True))
    ids, transmitted, ratios = columns["id"], columns.get(TRANSMITTED), columns.get(N_RATIO)
    wrong = ids[~(np.abs(ids) < 2**53) | (np.rint(ids) != ids)]
    if len(wrong):
        text = f"{len(wrong)} ids are not whole numbers below 2^53, the first is {wrong[0]:g}"
        raise ValueError(f"{text}; expected the ids of the rays")
    if ratios is not None:
        wrong = ratios[~((ratios >= LEAST_RATIO) & (ratios <= 1 / LEAST_RATIO))]
        if len(wrong):
            text = f"{N_RATIO} is {wrong[0]:g} for {len(wrong)} rays"
            raise ValueError(f"{text}; expected n_from / n_to, {LEAST_RATIO:g} … {1 / LEAST_RATIO:g}")
    return Answers(ids.astype(np.int64), table.numbers[:, 1:4], transmitted, table.header, ratios, table.digest)


def answers_of(
    command: Sequence[str],
    rays: RaySet,
    *,
    timeout: float = TIMEOUT,
    cwd: str | Path | None = None,
    env: Mapping[str, str] | None = None,
) -> Answers:
    """The answers of a program that reads rays from stdin and writes answers to stdout within `timeout` seconds.

    Its stderr is passed through. All processes of its group end with it. ValueError, one line that begins with the
    command, if the program ends with a status other than 0, takes too long, does not print answers, or prints more than
    two answers for each ray need. OSError if it cannot be started.
    """
    if not command:
        raise ValueError("no command; expected mi-refract rays run [OPTIONS] -- COMMAND")
    name = shlex.join(command)
    if not 0 <= timeout <= process_group.LONGEST:
        raise ValueError(f"--timeout {timeout:g}; expected 0 … {process_group.LONGEST:g} seconds")
    most = min(most_answers(rays) * _ROW_BYTES + _TOP_BYTES, _TEXT_BYTES)
    try:
        ended = process_group.run(command, as_csv(rays).encode(), timeout, cwd=cwd, env=env, most=most)
    except TooMuchOutputError as error:
        raise ValueError(f"{name}: {error}; expected one answer per ray") from None
    except TimeoutError:
        raise ValueError(f"{name}: did not finish within {timeout:g} s; set a longer --timeout") from None
    except OSError as error:
        raise type(error)(f"{name}: cannot be started: {error.strerror or error}") from None
    if ended.status:
        raise ValueError(f"{name}: {ended.describe}; expected status 0")
    return parse_answers(ended.out, name)


# Tables of numbers from other programs -----------------------------------------------------------------------------


class Table(NamedTuple):
    """A header, empty if the file has none; the names of the columns; their numbers (N, columns), float64.

    `digest`: SHA-256 of the bytes that were read; "" if it is not known.
    """

    header: Header
    columns: Layout
    numbers: Array
    digest: str = ""


def _read(path: Path, layouts: Sequence[Layout], most: int, convert: Callable[[Table], T]) -> T:
    """The result of `convert` for the table in a file, which must have one of the layouts and at most `most` rows."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: expected a file name that ends in {' or '.join(SUFFIXES)}")
    if suffix == ".npz":
        largest = most * _NUMBER_BYTES * max(map(len, layouts)) + _NPZ_MORE_BYTES
    else:
        largest = most * _ROW_BYTES + _TOP_BYTES
    with safe_files.opened(path, largest) as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
        stream.seek(0)
        try:
            return convert(_READERS[suffix](stream, layouts, most)._replace(digest=digest))
        except ValueError as error:
            raise ValueError(f"{path}: {one_line(str(error))}") from None


class _TooLongError(ValueError):
    """A line or a table is too long."""


def _read_csv(stream: BinaryIO, layouts: Sequence[Layout], most: int) -> Table:
    """The table in CSV text of at most `most` rows, whose column names must be one of the layouts, in order."""
    number, line, rows_left = 0, "", most + 1  # one more for the row of column names

    def lines(text: io.TextIOWrapper) -> Iterator[str]:
        nonlocal number, line, rows_left
        for line in iter(lambda: text.readline(_LONGEST_LINE + 1), ""):
            number += 1
            if len(line) > _LONGEST_LINE:
                raise _TooLongError(f"line {number} is longer than {_LONGEST_LINE} characters")
            if line.strip():
                rows_left -= not line.startswith("#")
                if rows_left < 0:
                    raise _TooLongError(f"more than {most} rows; expected up to {most}")
                yield _NAN.sub("nan", line) if "(" in line else line

    try:
        with io.TextIOWrapper(stream, "utf-8-sig") as text:
            rows, header, columns = lines(text), Header(), tuple[str, ...]()
            for top in rows:
                key, colon, value = top.partition(":")
                if not key.startswith("#"):
                    columns = tuple(column.strip() for column in top.split(","))
                    break
                header[key[1:].strip()] = _value(value.strip()) if colon else ""
            if columns not in layouts:
                reason = f"the first row is {','.join(columns)[:60]!r}" if columns else "the table is empty"
                raise ValueError(f"{reason}; expected, in this order: {' or '.join(map(','.join, layouts))}")
            with warnings.catch_warnings(action="ignore", category=UserWarning):  # "input contained no data"
                try:
                    numbers = np.loadtxt(rows, delimiter=",", ndmin=2)  # with `max_rows` it would allocate them all
                except (_TooLongError, UnicodeDecodeError):
                    raise
                except ValueError:
                    numbers = np.empty((1, 0))
    except UnicodeDecodeError:
        raise ValueError("not text; expected CSV in UTF-8") from None
    if len(numbers) and numbers.shape[1] != len(columns):
        raise ValueError(f"line {number} is {line.rstrip()[:60]!r}; expected {len(columns)} numbers")
    return Table(header, columns, numbers.reshape(-1, len(columns)))


def _value(text: Any) -> Any:
    """The value of JSON text; any other text unchanged; None if `text` is not a string."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):  # the latter for text that is nested too deeply for the parser
        return text
    except TypeError:
        return None


def _read_npz(stream: BinaryIO, layouts: Sequence[Layout], most: int) -> Table:
    """The table in an archive, in its largest layout; no other array, and none that is too large, is unpacked."""

    def array_name(column: str) -> str:
        return column[0] if len(column) == 2 and column[1] in "xyz" else column

    try:
        with zipfile.ZipFile(stream) as archive:
            members = {name.removesuffix(".npy") for name in archive.namelist()}
            complete = [layout for layout in layouts if all(array_name(column) in members for column in layout)]
            columns = max(complete, key=len, default=layouts[0])
            widths = Counter(map(array_name, columns))
            arrays = {}
            for name, width in widths.items():
                array = _array(archive, name, most * _NUMBER_BYTES * width)
                if not array.ndim or array.shape[1:] not in ((width,), ()) or array.size != len(array) * width:
                    raise ValueError(f"{name} has the shape {array.shape}, not (rows, {width})")
                if array.dtype.kind not in "biuf":
                    raise ValueError(f"{name} contains {array.dtype}, not real numbers")
                if len(array) > most:
                    raise ValueError(f"{len(array)} rows, more than {most}")
                with np.errstate(over="ignore"):
                    arrays[name] = array.reshape(len(array), width).astype(np.float64)
            if len({len(array) for array in arrays.values()}) > 1:
                raise ValueError(", ".join(f"{name} has {len(array)} rows" for name, array in arrays.items()))
            text = _array(archive, "header", _NPZ_HEADER_BYTES) if "header" in members else np.array("")
            if text.shape or text.dtype.kind != "U":
                raise ValueError(f"header is {text.dtype} of the shape {text.shape}, not text")
    except _NPZ_ERRORS as error:
        reason, expected = one_line(str(error)) or type(error).__name__, dict.fromkeys(map(array_name, layouts[0]))
        raise ValueError(f"{reason}; expected an .npz file with {', '.join(expected)}") from None
    header = _value(str(text))
    return Table(header if isinstance(header, dict) else {}, columns, np.hstack(list(arrays.values())))


def _array(archive: zipfile.ZipFile, name: str, most: int) -> NDArray[Any]:
    """A member of up to `most` bytes, read to its end, as zipfile checks the checksum only there."""
    try:
        info = archive.getinfo(f"{name}.npy")
    except KeyError:
        raise ValueError(f"there is no {name}") from None
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is compressed by method {info.compress_type}")
    if info.file_size > most + _ARRAY_TOP_BYTES:
        raise ValueError(f"{name} has {info.file_size} bytes, more than {most + _ARRAY_TOP_BYTES}")
    with archive.open(info) as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False)
        if stream.read(1):
            raise ValueError(f"{name} is longer than its shape, {array.shape}")
    return array


_READERS = {".csv": _read_csv, ".npz": _read_npz}
