"""Sets of incident rays for other programs' refraction, and the answers that come back.

A set holds one or several regimes of `mi_refract.regimes`, rounded to float32 or float64. The same regimes, count,
precision and seed give the same set, bit for bit. The ratio n_from / n_to is exact: n_to is a power of two, 1 where it
can be, and no index is below 1. So a program that divides them, in either precision, gets exactly the k of the ray.
With media and wavelengths (see `media_rays`), their ratios take the place of the regimes' own.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from mi_refract import regimes
from mi_refract.numerics import float_expansions
from mi_refract.regimes import Rays

from . import media_rays
from .header import FORMAT, PRECISIONS, Header

# Their vectors are unit up to the rounding of each component, as the documented formulas require.
DEFAULT = tuple(name for name, regime in regimes.REGIMES.items() if regime.unit and not regime.rests_on_denormals)
COUNT, PRECISION = 1000, "f32"
_HASHED = 2**16  # rays at a time
CONVENTIONS = {
    "a": "incident direction, pointing toward the surface",
    "n": "normal, on the side that the ray comes from: n.a <= 0",
    "n, two-sided": "normal, on either side of the surface",
    "n_from, n_to": "indices of the media that the ray leaves and enters; k = n_from / n_to is exact",
    "answer": "id, bx, by, bz: the direction after the surface; optionally transmitted: 1, or 0 where all is reflected",
}


def indices(k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n_from, n_to), each (N,) and at least 1. Their ratio is k, exactly."""
    _, exponent = np.frexp(k)
    n_to = np.ldexp(np.ones_like(k), np.maximum(1 - exponent, 0))
    return k * n_to, n_to


@dataclass(frozen=True)
class RaySet:
    """Rays (N), their ids (N,), the name of each ray's regime (N,), and the header of the file."""

    rays: Rays
    ids: np.ndarray
    regime: np.ndarray
    header: Header

    def __len__(self) -> int:
        """The number of rays."""
        return len(self.ids)

    @property
    def precision(self) -> str:
        """ "f32" or "f64": the precision of the numbers, and the one that the answers claim."""
        return str(self.header["precision"])

    @property
    def roundoff(self) -> float:
        """Half an ulp of 1 in the set's precision."""
        return float(np.finfo(PRECISIONS[self.precision]).eps) / 2

    @property
    def numbers(self) -> np.ndarray:
        """(N, 9) float64: id, a, n, n_from, n_to; with media (N, 11): wavelength, medium."""
        return numbers_of(self.ids, self.rays, self.header)


def numbers_of(ids: np.ndarray, rays: Rays, header: Header) -> np.ndarray:
    """(N, 9) float64: id, a, n, n_from, n_to; with media (N, 11): wavelength, medium."""
    return np.column_stack(
        [ids, rays.a, rays.n, *indices(rays.k), *media_rays.columns(header, ids).T],
    ).astype(np.float64)


@dataclass(frozen=True)
class Answers:
    """A program's answers: ids (N,), b (N, 3) float64, the column `transmitted` (N,) if there is one, the header.

    `transmitted`: of True and False, or of 1 and 0.
    `n_ratio`: (N,) the n_from / n_to that the program used, if it says so.
    """

    ids: np.ndarray
    b: np.ndarray
    transmitted: np.ndarray | None = None
    header: Header = field(default_factory=dict)
    n_ratio: np.ndarray | None = None

    def __post_init__(self) -> None:
        """ValueError where the shapes do not match, and for a `transmitted` that is neither 0 nor 1."""
        more = [each.shape for each in (self.transmitted, self.n_ratio) if each is not None]
        if self.b.shape != (len(self.ids), 3) or any(shape != self.ids.shape for shape in more):
            raise ValueError(f"answers: b is {self.b.shape} for {len(self.ids)} ids; accepted: a direction for each id")
        if self.transmitted is not None:
            if (wrong := self.transmitted[~np.isin(self.transmitted, (0, 1))]).size:
                raise ValueError(f"answers: transmitted is {wrong[0]}; expected 0 or 1")
            object.__setattr__(self, "transmitted", self.transmitted.astype(bool))  # `~` of an integer is another one


def default(media: Sequence[str] = ()) -> tuple[str, ...]:
    """The names of DEFAULT; with media those whose ratios are not their own."""
    return tuple(name for name in DEFAULT if not len(media) or name in media_rays.NAMES)


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

    `media`: what `mi_refract.media` parses; each ray passes between one of them and air, at one of the `wavelengths` in
    nm. Errors as of `header_of`.
    """
    header = header_of(names, count, precision, seed, two_sided, media, wavelengths)
    rays = Rays.joined([of_regime(name, header) for name in header["regimes"]])
    return _with_checksum(RaySet(rays, np.arange(len(rays)), regime_names(header, len(rays)), header))


def header_of(
    names: Iterable[str] | None,
    count: int,
    precision: str,
    seed: int,
    two_sided: bool,
    media: Sequence[str] = (),
    wavelengths: Sequence[float] = (),
) -> Header:
    """The header of the set that is made so, without its checksum.

    ValueError for an unknown regime or precision, a regime given twice, or no ray at all; of media see
    `media_rays.header_of` and `media_rays.check_regimes`.
    """
    names = default(media) if names is None else tuple(names)
    if unknown := [name for name in names if name not in regimes.REGIMES]:
        raise ValueError(f"regime {unknown[0]!r}: unknown; accepted: {', '.join(map(repr, regimes.REGIMES))}")
    if precision not in PRECISIONS:
        raise ValueError(f"precision {precision!r}: unknown; accepted: {', '.join(PRECISIONS)}")
    if not names or len(set(names)) < len(names) or count < 1 or seed < 0:
        raise ValueError(f"{count} rays of {list(names)}, seed {seed}: accepted: at least one ray, each regime once")
    header = _header(names, count, precision, seed, two_sided)
    if len(media) or len(wavelengths):
        header |= media_rays.header_of(media, wavelengths, precision)
        media_rays.check_regimes(header)
    return header


def of_regime(name: str, header: Header) -> Rays:
    """The rays of one regime of the set with this header."""
    precision, seed = PRECISIONS[header["precision"]], header["seed"]
    if media_rays.has_media(header):
        first, last = header["regimes"][name]
        k = media_rays.ratios(header, np.arange(first, last + 1))
        rays = regimes.make_given(name, k, precision, seed)
    else:
        rays = regimes.make(name, header["count"], precision, seed)
    return rays if header["two_sided"] else facing(rays)


def facing(rays: Rays) -> Rays:
    """The same rays, each with its normal on the side that it comes from."""
    c = float_expansions.dot(rays.n.T.astype(np.float64), rays.a.T.astype(np.float64))[0]
    return Rays(rays.a, np.where(c[:, None] > 0, -rays.n, rays.n), rays.k)


def _header(names: Sequence[str], count: int, precision: str, seed: int, two_sided: bool) -> Header:
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


def regime_names(header: Header, count: int) -> np.ndarray:
    """(count,): the regime of each ray, by the ranges of ids in the header."""
    names = np.full(count, "", dtype=object)
    for name, (first, last) in header["regimes"].items():
        names[first : last + 1] = name
    return names


def _with_checksum(rays: RaySet) -> RaySet:
    return RaySet(rays.rays, rays.ids, rays.regime, rays.header | {"checksum": checksum(rays)})


def checksum(rays: RaySet) -> str:
    """SHA-256 of the header without its own line, and of the numbers. It does not depend on the file format."""
    digest = Checksum(rays.header)
    for i in range(0, len(rays), _HASHED):  # all numbers in float64 take several times what the rays do
        digest.add_numbers(numbers_of(rays.ids[i : i + _HASHED], rays.rays[i : i + _HASHED], rays.header))
    return digest.text


class Checksum:
    """As `checksum`, of rays that come in pieces."""

    def __init__(self, header: Header) -> None:
        """`header`: with or without the line of the checksum."""
        hashed = {key: value for key, value in header.items() if key != "checksum"}
        self._digest = hashlib.sha256(json.dumps(hashed, sort_keys=True).encode())

    def add_numbers(self, numbers: np.ndarray) -> None:
        """The next rows of the set's numbers."""
        self._digest.update(numbers.astype("<f8").tobytes())

    @property
    def text(self) -> str:
        """What the header says."""
        return f"sha256:{self._digest.hexdigest()}"
