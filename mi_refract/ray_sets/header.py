"""The header of a file of rays: its keys, and what each of them may be."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType
from numpy.typing import NDArray

from mi_refract.io.typed_table import convert

Ids = NDArray[np.int64]
Header = dict[str, Any]  # the `# key: value` lines of a file

FORMAT = "mi_refract rays 1"
PRECISIONS: dict[str, type[np.floating]] = {"f32": np.float32, "f64": np.float64}
AUTO, FLAG = "auto", "flag"  # detect the signal of total internal reflection; the column `transmitted` is it
TIR = ("zero", "nan", "reflected", "tangent", FLAG)  # the signals
LARGEST_WAVELENGTH = 1e9  # nm
MOST_MEDIA = 64  # media of a set, and wavelengths

Text = Annotated[str, Meta(min_length=1, max_length=200)]
MediumName = Annotated[str, Meta(min_length=1, max_length=512)]
Wavelength = Annotated[float, Meta(gt=0, lt=LARGEST_WAVELENGTH)]


class RaysHeader(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The keys of a header. Those of media are all there or none."""

    format: Literal["mi_refract rays 1"]
    version: Text
    precision: Literal["f32", "f64"]
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)]
    count: Annotated[int, Meta(ge=1, le=2**63 - 1)]
    two_sided: bool
    a: Text
    n: Text
    indices: Text = msgspec.field(name="n_from, n_to")
    answer: Text
    regimes: dict[Text, tuple[int, int]]  # first and last id
    checksum: Annotated[str, Meta(pattern="^sha256:[0-9a-f]{64}$")]
    columns_of_media: MediumName | UnsetType = msgspec.field(name="wavelength, medium", default=UNSET)
    media: Annotated[list[tuple[MediumName, MediumName]], Meta(min_length=2, max_length=2 * MOST_MEDIA)] | UnsetType = (
        UNSET
    )
    wavelengths: Annotated[list[Wavelength], Meta(min_length=1, max_length=MOST_MEDIA)] | UnsetType = UNSET

    def __post_init__(self) -> None:
        """ValueError for some keys of media without the others."""
        keys = {"wavelength, medium": self.columns_of_media, "media": self.media, "wavelengths": self.wavelengths}
        missing = [key for key, value in keys.items() if value is UNSET]
        if 0 < len(missing) < len(keys):
            raise ValueError(f"no key `{missing[0]}`; expected all of {', '.join(f'`{key}`' for key in keys)}, or none")


def check(header: Mapping[str, Any], rays: int) -> None:
    """ValueError, one line, for a header that `ray_set.make` does not write for so many rays.

    Each regime has `count` rays, one after the other: no ray is without a regime, and none is in two.
    """
    convert(dict(header), RaysHeader, "header")
    count, regimes = header["count"], header["regimes"]
    if count * len(regimes) != rays or not rays:
        found = f"the header declares {len(regimes)} × {count} rays, the file has {rays}"
        raise ValueError(f"{found}; expected `count` rays of each regime")
    for i, (name, ends) in enumerate(regimes.items()):
        if ends != [i * count, (i + 1) * count - 1]:
            found = f"header: regimes: {shown(name)} has the ids {shown(ends)}"
            raise ValueError(f"{found}; expected {[i * count, (i + 1) * count - 1]}")


def as_json(text: str) -> Any:
    """The value of JSON text. ValueError for any other text, also where it is nested too deep for the parser."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply; expected JSON") from None


def shown(value: Any) -> str:
    """Any value of a header in an error: quoted, and not long."""
    try:
        text = ascii(value)
    except (RecursionError, ValueError):  # a number of thousands of digits
        text = type(value).__name__
    return text if len(text) <= 60 else f"{text[:60]}…"
