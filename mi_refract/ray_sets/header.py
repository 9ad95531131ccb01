"""The header of a file of rays: its keys and their valid values, and the medium and wavelength of each ray.

In a set with media, the ratios of indices are those of media at wavelengths. Each ray has a wavelength and a pair of
media, [from, to]: one of them is a medium of `mi_refract.media`, the other is air, whose index is 1. Both follow from
the header and from the ray's position in its regime, so they are never stored: the medium varies fastest, then the
wavelength, then the direction of the pair. For a regime that needs k ≥ 1, the pair has the direction that gives it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType
from numpy.typing import NDArray

from mi_refract import media
from mi_refract.io.text import parse_number
from mi_refract.io.typed_table import convert, doc
from mi_refract.regimes import REGIMES, Array

Ids = NDArray[np.int64]
Header = dict[str, Any]  # the `# key: value` lines of a file

FORMAT = "mi_refract rays 1"
PRECISIONS: dict[str, type[np.floating]] = {"f32": np.float32, "f64": np.float64}
AUTO, FLAG = "auto", "flag"  # detect the signal of total internal reflection; the signal is the column `transmitted`
TIR = ("zero", "nan", "reflected", "tangent", FLAG)  # signals of total internal reflection
LARGEST_WAVELENGTH = 1e9  # nm
MOST_MEDIA = 64  # largest number of media in a set, and of wavelengths
AIR = "air"
COLUMNS = ("wavelength", "medium")  # additional columns of rays with media
CONVENTION = (
    "wavelength in nm; medium: the number, from 0, of the pair [from, to] in `media`; n_from / n_to is the ratio of "
    "their indices at that wavelength, where air has the index 1"
)
SMALLEST, LARGEST = 1e-6, 1e6  # ratios
# Ratios of media count as equal up to this relative difference: five decimals of a manufacturer, or another dispersion
# formula of the same glass, can differ by as much.
SAME = 1e-5
TAKE_RATIOS = tuple(name for name, regime in REGIMES.items() if regime.takes_k)  # regimes that accept given ratios
_AIR = dataclasses.replace(media.parse(1.0), name=AIR, relative_to="air")

Text = Annotated[str, Meta(min_length=1, max_length=200)]
MediumName = Annotated[str, Meta(min_length=1, max_length=512)]
Wavelength = Annotated[float, Meta(gt=0, lt=LARGEST_WAVELENGTH)]
Wavelengths = Annotated[list[Wavelength], Meta(min_length=1, max_length=MOST_MEDIA)]
Pairs = Annotated[list[tuple[MediumName, MediumName]], Meta(min_length=2, max_length=2 * MOST_MEDIA)]


class RaysHeader(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The keys of a header. The keys of media are all present or all absent."""

    format: Annotated[Literal["mi_refract rays 1"], doc("the format, and its version")]
    version: Annotated[Text, doc("version of mi_refract that wrote the file")]
    precision: Annotated[Literal["f32", "f64"], doc("precision of all numbers except `id`")]
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1), doc("seed of the random rays")]
    count: Annotated[int, Meta(ge=1, le=2**63 - 1), doc("number of rays of each regime")]
    two_sided: Annotated[bool, doc("whether normals may be on either side of the surface")]
    a: Annotated[Text, doc("meaning of `ax, ay, az`, for readers")]
    n: Annotated[Text, doc("meaning of `nx, ny, nz`, for readers")]
    indices: Annotated[Text, doc("their meaning, for readers")] = msgspec.field(name="n_from, n_to")
    answer: Annotated[Text, doc("the columns of an answer, for readers")]
    regimes: Annotated[dict[Text, tuple[int, int]], doc("first and last id of each regime")]
    checksum: Annotated[str, Meta(pattern="^sha256:[0-9a-f]{64}$"), doc("checksum of header and rays")]
    columns_of_media: Annotated[MediumName | UnsetType, doc("only with media: their meaning, for readers")] = (
        msgspec.field(name="wavelength, medium", default=UNSET)
    )
    media: Annotated[Pairs | UnsetType, doc("only with media: pairs [from, to] for the column `medium`")] = UNSET
    wavelengths: Annotated[Wavelengths | UnsetType, doc("only with media: wavelengths in nm")] = UNSET

    def __post_init__(self) -> None:
        """ValueError if only some of the keys of media are present."""
        keys = {"wavelength, medium": self.columns_of_media, "media": self.media, "wavelengths": self.wavelengths}
        missing = [key for key, value in keys.items() if value is UNSET]
        if 0 < len(missing) < len(keys):
            raise ValueError(f"no key `{missing[0]}`; expected all of {', '.join(f'`{key}`' for key in keys)}, or none")


def check(header: Header, rays: int) -> None:
    """ValueError, one line, for a header that `ray_set.make` would not write for this number of rays.

    Each regime has `count` consecutive rays: every ray is in exactly one regime.
    """
    convert(header, RaysHeader, "header")
    count, regimes = header["count"], header["regimes"]
    if count * len(regimes) != rays or not rays:
        text = f"the header declares {len(regimes)} × {count} rays, the file has {rays}"
        raise ValueError(f"{text}; expected `count` rays of each regime")
    for i, (name, ends) in enumerate(regimes.items()):
        if ends != [i * count, (i + 1) * count - 1]:
            text = f"header: regimes: {shown(name)} has the ids {shown(ends)}"
            raise ValueError(f"{text}; expected {[i * count, (i + 1) * count - 1]}")
    if has_media(header):
        names = [pair[0] for pair in header["media"][::2]]
        expected = of_media(names, header["wavelengths"], header["precision"])["media"]
        if header["media"] != expected:
            raise ValueError(f"header: media: {shown(header['media'])}; expected {shown(expected)}")
        check_regimes(header)


def shown(value: Any) -> str:
    """A value of a header as text for an error: quoted, and at most 61 characters long."""
    try:
        text = ascii(value)
    except (RecursionError, ValueError):  # a number of thousands of digits
        text = type(value).__name__
    return text if len(text) <= 60 else f"{text[:60]}…"


# Media -------------------------------------------------------------------------------------------------------------


def has_media(header: Mapping[str, Any]) -> bool:
    """Whether the set with this header has wavelengths and media."""
    return "media" in header


def of_media(specs: Sequence[str], wavelengths: Sequence[float], precision: str) -> Header:
    """The keys of a header for these media and wavelengths (nm).

    ValueError, one line, for no media or no wavelengths, too many, duplicates in the set's precision, an unknown
    medium, or a medium without an index at one of the wavelengths.
    """
    text = f"{len(specs)} media and {len(wavelengths)} wavelengths"
    if not len(specs) or not len(wavelengths):
        raise ValueError(f"{text}; expected neither, or at least one of each")
    if max(len(specs), len(wavelengths)) > MOST_MEDIA:
        raise ValueError(f"{text}; expected up to {MOST_MEDIA} of each")
    if wrong := [x for x in wavelengths if not 0 < x < LARGEST_WAVELENGTH]:
        raise ValueError(f"wavelength {wrong[0]:g}; expected nm, a number above 0")
    rounded = _rounded(wavelengths, precision)
    if len(np.unique(rounded)) < len(rounded) or not rounded.all():
        text = f"the wavelengths {shown(wavelengths)} are not all different in {precision}"
        raise ValueError(f"{text}; expected each once")
    names = [_parsed(spec).name for spec in specs]
    if repeated := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"medium {shown(repeated[0])}: {names.count(repeated[0])} times; expected each once")
    in_nm = [float(x) for x in wavelengths]
    _ratios(tuple(names), tuple(in_nm), precision)
    pairs = [pair for name in names for pair in ([name, AIR], [AIR, name])]
    return {"wavelength, medium": CONVENTION, "media": pairs, "wavelengths": in_nm}


def check_regimes(header: Header) -> None:
    """ValueError, one line, for a regime that defines its own ratios, or for fewer rays than combinations of media."""
    if refused := [name for name in header["regimes"] if name in REGIMES and name not in TAKE_RATIOS]:
        text = f"regime {refused[0]!r} defines its own ratios of indices"
        raise ValueError(f"{text}; with media, expected one of {', '.join(map(repr, TAKE_RATIOS))}")
    least = len(header["media"]) * len(header["wavelengths"])
    if header["count"] < least:
        text = f"{header['count']} rays of each regime"
        raise ValueError(f"{text}; expected {least} or more, one for each medium, wavelength and side of the surface")


def columns(header: Header, ids: Ids) -> Array:
    """(N, 2) float64 for the rays with these ids (N,): wavelength in nm, number of the pair; (N, 0) without media."""
    if not has_media(header):
        return np.empty((len(ids), 0))
    pairs, wavelengths = _combinations(header, ids)
    return np.column_stack([_rounded(header["wavelengths"], header["precision"])[wavelengths], pairs])


def ratios(header: Header, ids: Ids) -> Array:
    """(N,) n_from / n_to of the rays with these ids, in the set's precision, as float64. Precondition: `has_media`."""
    return _ratio_table(header)[_combinations(header, ids)]


def described(header: Header, id_: int) -> str:
    """The media and the wavelength of a ray, as in "SCHOTT:N-BK7 to air at 486.133 nm"; "" without media."""
    if not has_media(header):
        return ""
    ((wavelength, pair),) = columns(header, np.array([id_]))
    outside, inside = header["media"][int(pair)]
    return f"{outside} to {inside} at {wavelength:.9g} nm"


def check_ratios(header: Header, k: Array) -> None:
    """ValueError, one line, if `k` (N,) of all rays is not the ratio of their media."""
    if has_media(header):
        expected = ratios(header, np.arange(len(k)))
        wrong = np.flatnonzero(~(np.abs(k.astype(np.float64) - expected) <= SAME * expected))
        if len(wrong):
            text = f"ray {wrong[0]} has n_from / n_to = {float(k[wrong[0]]):.9g}"
            raise ValueError(f"{text}; expected {expected[wrong[0]]:.9g}, {described(header, int(wrong[0]))}")


def _combinations(header: Header, ids: Ids) -> tuple[Ids, Ids]:
    """For each ray, the number of its pair (N,) and of its wavelength (N,)."""
    count, medium_count = header["count"], len(header["media"]) // 2
    position = ids % count
    medium, rest = position % medium_count, position // medium_count
    wavelength, turned = rest % len(header["wavelengths"]), rest // len(header["wavelengths"]) % 2
    least = np.array([REGIMES[name].least_k if name in REGIMES else 0.0 for name in header["regimes"]])[ids // count]
    turned = np.where(least > 0, _ratio_table(header)[2 * medium, wavelength] < least, turned)
    return 2 * medium + turned, wavelength


def _ratio_table(header: Header) -> Array:
    names = tuple(pair[0] for pair in header["media"][::2])
    return _ratios(names, tuple(header["wavelengths"]), header["precision"])


@functools.lru_cache(maxsize=8)
def _ratios(names: tuple[str, ...], wavelengths: tuple[float, ...], precision: str) -> Array:
    """(pairs, wavelengths) n_from / n_to in the set's precision, as float64."""
    nm, rows = _rounded(wavelengths, precision), []
    for medium in map(_parsed, names):
        for wavelength in nm.tolist():  # one by one, so that an error names the first wavelength without an index
            medium.index(wavelength)
        rows += [media.relative_index(*pair, nm) for pair in ((medium, _AIR), (_AIR, medium))]
    k = _rounded(np.array(rows), precision)
    wrong = np.argwhere(~((k >= SMALLEST) & (k <= LARGEST)))
    if len(wrong):
        pair, i = wrong[0]
        text = f"{names[pair // 2]}: n = {float(rows[pair - pair % 2][i]):.6g} beside air at {nm[i]:.9g} nm"
        raise ValueError(f"{text}; expected {SMALLEST:g} … {LARGEST:g}")
    return k


def _parsed(spec: str) -> media.Medium:
    """The medium of a text. ValueError, one line, for another text, and for a name of Mitsuba's table."""
    with contextlib.suppress(ValueError):
        parse_number(spec.replace("-", ""))  # an index, or the code of a glass
        return media.parse(spec)
    if ":" not in spec and "(" not in spec:
        expected = "a number, cauchy(A, B, …) or another formula, SCHOTT:N-BK7 or another glass"
        raise ValueError(f"medium {shown(spec)}; expected {expected}")
    return media.parse(spec, "medium")


def _rounded(numbers: Iterable[float] | Array, precision: str) -> Array:
    with np.errstate(over="ignore"):
        return np.asarray(numbers, np.float64).astype(PRECISIONS[precision]).astype(np.float64)
