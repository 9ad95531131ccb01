"""What ends a render: its number of samples, its estimated error, its time, or a scene without noise."""

from __future__ import annotations

from dataclasses import dataclass

from . import error_estimate
from .pass_plan import FEW
from .pass_sums import PassSums

NO_NOISE = "no noise: the samples of every pixel agree"


@dataclass(frozen=True)
class Limits:
    """The first of these that is reached ends a render.

    `until`, `until_tile`: relative errors, of the image and of its worst tiles; `seconds`: of this run. `spp`: samples
    per pixel; None: those of the scene, where nothing else ends the render. `pass_spp`: samples per pixel of a pass.
    ValueError for a number out of range.
    """

    spp: int | None = None
    until: float | None = None
    until_tile: float | None = None
    seconds: float | None = None
    pass_spp: int | None = None

    def __post_init__(self) -> None:  # noqa: D105
        for name in ("spp", "pass_spp"):
            if (value := getattr(self, name)) is not None and not 1 <= value < 2**32:
                raise ValueError(f"{name} = {value}; expected a whole number from 1 to 2³² − 1")
        for name in ("until", "until_tile"):
            if (value := getattr(self, name)) is not None and not 0 < value <= 1:
                raise ValueError(f"{name} = {value:g}; expected more than 0 %, up to 100 %")
        if self.seconds is not None and not 0 < self.seconds < float("inf"):
            raise ValueError(f"time = {self.seconds:g} s; expected more than 0")

    @property
    def open_ended(self) -> bool:
        """Whether something else than a number of samples ends the render."""
        return any(limit is not None for limit in (self.until, self.until_tile, self.seconds))


def reached(limits: Limits, sums: PassSums) -> str:
    """Why an image is good enough: no noise, or an error that was asked for; "" where it is not."""
    if error_estimate.without_noise(sums):
        return NO_NOISE
    if sums.passes < FEW:  # their spread says too little
        return ""
    if limits.until and (error := error_estimate.relative_error(sums)).high <= limits.until:
        until, value, high = (f"{100 * share:.3g} %" for share in (limits.until, error.value, error.high))
        return f"--until {until}: the error is {value}, at most {high}"
    if limits.until_tile and (worst := error_estimate.worst_tile(sums)) <= limits.until_tile:
        until, value = (f"{100 * share:.3g} %" for share in (limits.until_tile, worst))
        return f"--until-tile {until}: the error of the worst tile is {value}"
    return ""
