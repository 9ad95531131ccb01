"""Sets of incident rays for other programs, and their answers.

A set contains one or several regimes of `mi_refract.regimes`, rounded to float32 or float64. The same regimes, count,
precision and seed give the same set, bit for bit; in float64 only on processors with the same instructions, on which
the last bit of NumPy's functions depends. The header's checksum distinguishes sets. The ratio n_from / n_to is exact:
n_to is a power of two, 1 if possible, and no index is below 1. So a program that divides them, in either precision,
gets exactly the k of the ray. With media and wavelengths (see `header`), their ratios replace the regimes' own.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract import regimes
from mi_refract.numerics import float_expansions
from mi_refract.regimes import Array, Rays

from . import header as headers
from .header import FORMAT, PRECISIONS, Header, Ids

Rows = NDArray[np.bool_] | NDArray[np.intp] | slice  # a mask (N,), indices, or a range

# Regimes whose vectors are unit up to the rounding of each component, as the documented formulas require.
DEFAULT = tuple(name for name, regime in regimes.REGIMES.items() if regime.unit and not regime.rests_on_denormals)
COUNT, PRECISION = 1000, "f32"
MOST_RAYS = 2**28 // 9  # 3e7: their numbers, 9 each, take 2 GiB, and checking them takes 8 GB


def indices(k: Array) -> tuple[Array, Array]:
    """(n_from, n_to), each (N,) and at least 1. Their ratio is exactly k."""
    _, exponent = np.frexp(k)
    n_to = np.ldexp(np.ones_like(k), np.maximum(1 - exponent, 0))
    return k * n_to, n_to


@dataclass(frozen=True)
class RaySet:
    """Rays (N), their ids (N,), and the header of the file, whose ranges of ids name the regimes."""

    rays: Rays
    ids: Ids
    header: Header

    def __len__(self) -> int:
        """The number of rays."""
        return len(self.ids)

    def __getitem__(self, rows: Rows) -> RaySet:
        """The selected rays, with the same header."""
        return RaySet(self.rays[rows], self.ids[rows], self.header)

    @property
    def precision(self) -> str:
        """ "f32" or "f64": the precision of the rays, and that claimed for the answers."""
        return str(self.header["precision"])

    @property
    def roundoff(self) -> float:
        """Half an ulp of 1 in the set's precision."""
        return float(np.finfo(PRECISIONS[self.precision]).eps) / 2

    @functools.cached_property
    def regime(self) -> NDArray[np.object_]:
        """(N,) the name of each ray's regime."""
        names = np.full(len(self), "", dtype=object)
        for name in self.header["regimes"]:
            names[in_regime(self.header, name, self.ids)] = name
        return names

    @property
    def numbers(self) -> Array:
        """(N, 9) float64: id, a, n, n_from, n_to; with media (N, 11): wavelength, medium."""
        rays, media_columns = self.rays, headers.columns(self.header, self.ids).T
        numbers = [self.ids, rays.a, rays.n, *indices(rays.k), *media_columns]
        return np.column_stack(numbers).astype(np.float64)


def in_regime(header: Header, name: str, ids: Ids) -> NDArray[np.bool_]:
    """(N,) whether each id is in the range of a regime."""
    first, last = header["regimes"][name]
    return np.asarray((ids >= first) & (ids <= last))


@dataclass(frozen=True)
class Answers:
    """A program's answers: ids (N,), directions b (N, 3) float64, and optional columns.

    `transmitted`: (N,) True and False, or 1 and 0, if the column exists.
    `header`: of the file; empty if it has none.
    `n_ratio`: (N,) the n_from / n_to that the program used, if it reports it.
    `digest`: SHA-256 of the file or of the program's output; "" for arrays.
    """

    ids: Ids
    b: Array
    transmitted: NDArray[Any] | None = None
    header: Header = field(default_factory=dict)
    n_ratio: Array | None = None
    digest: str = ""

    def __post_init__(self) -> None:
        """ValueError for shapes that do not match, and for a `transmitted` that is neither 0 nor 1."""
        columns = [column for column in (self.transmitted, self.n_ratio) if column is not None]
        if self.b.shape != (len(self.ids), 3) or any(column.shape != self.ids.shape for column in columns):
            raise ValueError(f"answers: b is {self.b.shape} for {len(self.ids)} ids; expected a direction for each id")
        if self.transmitted is not None:
            wrong = self.transmitted[~np.isin(self.transmitted, (0, 1))]
            if wrong.size:
                raise ValueError(f"answers: transmitted is {wrong[0]}; expected 0 or 1")
            # As bool, since `~` of an integer is not its negation.
            object.__setattr__(self, "transmitted", self.transmitted.astype(bool))

    def __getitem__(self, rows: Rows) -> Answers:
        """The selected answers, with the same header and digest."""
        columns = [None if column is None else column[rows] for column in (self.transmitted, self.n_ratio)]
        return Answers(self.ids[rows], self.b[rows], columns[0], self.header, columns[1], self.digest)


def default(media: Sequence[str] = ()) -> tuple[str, ...]:
    """The regimes of DEFAULT; with media, those that do not define their own ratios."""
    return tuple(name for name in DEFAULT if not len(media) or name in headers.TAKE_RATIOS)


def make(
    names: Iterable[str] | None = None,
    count: int = COUNT,
    precision: str = PRECISION,
    seed: int = 0,
    *,
    two_sided: bool = False,
    media: Sequence[str] = (),
    wavelengths: Sequence[float] = (),
) -> RaySet:
    """`count` rays of each regime in `names`, by default those of `default`. Normals face the ray unless `two_sided`.

    `media`: specifications for `mi_refract.media`; each ray passes between one of these media and air, at one of the
    `wavelengths` in nm. ValueError, one line, for an unknown regime or precision, a duplicate regime, no rays, or
    more than MOST_RAYS; and for media as in `header.of_media` and `header.check_regimes`.
    """
    from mi_refract import __version__

    names = default(media) if names is None else tuple(names)
    if unknown := [name for name in names if name not in regimes.REGIMES]:
        raise ValueError(f"regime {unknown[0]!r}: unknown; expected {', '.join(map(repr, regimes.REGIMES))}")
    if precision not in PRECISIONS:
        raise ValueError(f"precision {precision!r}: unknown; expected {', '.join(PRECISIONS)}")
    if not names or len(set(names)) < len(names) or count < 1 or seed < 0:
        raise ValueError(f"{count} rays of {list(names)}, seed {seed}; expected at least one ray, each regime once")
    if count * len(names) > MOST_RAYS:
        raise ValueError(f"{count} rays of each of {len(names)} regimes; expected up to {MOST_RAYS} rays in all")
    header: Header = {
        "format": FORMAT,
        "version": __version__,
        "precision": precision,
        "seed": seed,
        "count": count,
        "two_sided": two_sided,
        "a": "incident direction, pointing toward the surface",
        "n_from, n_to": "indices of the media that the ray leaves and enters; k = n_from / n_to is exact",
        "answer": "id, bx, by, bz: the direction after the surface; optionally transmitted: 1, or 0 where all is "
        "reflected",
        "n": "normal, on either side of the surface"
        if two_sided
        else "normal, on the side that the ray comes from: n.a <= 0",
        "regimes": {name: [i * count, (i + 1) * count - 1] for i, name in enumerate(names)},
    }
    if len(media) or len(wavelengths):
        header |= headers.of_media(media, wavelengths, precision)
        headers.check_regimes(header)
    parts = []
    for name, (first, last) in header["regimes"].items():
        if headers.has_media(header):
            k = headers.ratios(header, np.arange(first, last + 1))
            parts.append(regimes.make_given(name, k, PRECISIONS[precision], seed))
        else:
            parts.append(regimes.make(name, count, PRECISIONS[precision], seed))
    rays = Rays.joined(parts if two_sided else [facing(part) for part in parts])
    return with_checksum(RaySet(rays, np.arange(len(rays)), header))


def facing(rays: Rays) -> Rays:
    """The same rays, each with its normal on the side that the ray comes from."""
    c = float_expansions.dot(rays.n.T.astype(np.float64), rays.a.T.astype(np.float64))[0]
    return Rays(rays.a, np.where(c[:, None] > 0, -rays.n, rays.n), rays.k)


def checksum(header: Header, numbers: Array) -> str:
    """SHA-256 of the header without its checksum, and of `RaySet.numbers`. It does not depend on the file format."""
    hashed = {key: value for key, value in header.items() if key != "checksum"}
    digest = hashlib.sha256(json.dumps(hashed, sort_keys=True).encode())
    digest.update(np.ascontiguousarray(numbers, "<f8").data)
    return f"sha256:{digest.hexdigest()}"


def with_checksum(rays: RaySet) -> RaySet:
    """The set with its checksum in the header."""
    return replace(rays, header=rays.header | {"checksum": checksum(rays.header, rays.numbers)})
