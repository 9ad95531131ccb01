"""The passes of a render and their seeds, which depend on its film and its numbers of samples only.

    seed(s, p) = s ⊕ mix(p),    mix: the finaliser of MurmurHash3 on 32 bits, a bijection with mix(0) = 0

s is the seed of the render, p the number of the pass. All passes of one render have different seeds, and so have passes
of the same number in renders of different seeds. Pass 0 has the seed s. In scalar variants Mitsuba gives pixel k of B
the random numbers of sequence seed · N + k, modulo 2³². N is the number of pixels of the film, B that of all blocks
that cover it, of up to BLOCK² pixels each. There

    seed(s, p) = (mix(s) + p ⌈B/N⌉) mod M,    M = ⌊2³²/N⌋

so that no two of up to M/⌈B/N⌉ passes share a sequence. Two renders may have some passes in common, by chance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

LANES = 2**24  # most samples of a pass, unless one sample per pixel is more
# A pass has a fixed cost of about 12 ms, which is 1 or 2 % of the time of 2²¹ samples. Its sums cost as much as a
# quarter of a sample in every pixel. So a render of many samples has fewer and larger passes, but at least MANY.
LEAST_LANES, LEAST_SPP = 2**21, 4
LARGE_LANES, MANY = 2**23, 16
# Size of the first passes if the error ends the render: such a pass takes about 24 ms, so eight of them are soon done.
FIRST_LANES = 2**15
BLOCK = 32  # pixels: the side of Mitsuba's largest blocks in scalar variants
FEW = 8  # passes: the spread of fewer is a poor estimate
MASK = 2**32 - 1


def seed_of(seed: int, number: int) -> int:
    """Return the seed of pass `number` of a render with this seed, both from 0 to 2³² − 1."""
    return seed ^ _mix(number)


def scalar_seed_of(seed: int, number: int, width: int, height: int) -> int:
    """Return the same for scalar variants and a film of so many pixels. ValueError if passes would repeat."""
    pixels, in_blocks = width * height, -(-width // BLOCK) * -(-height // BLOCK) * BLOCK**2
    seeds, step = (MASK + 1) // pixels, -(-in_blocks // pixels)
    if number >= (most := seeds // step):
        text = f"pass {number} of {pixels} pixels; scalar variants support up to {most}"
        raise ValueError(f"{text}; use a larger --pass-spp")
    return (_mix(seed) + number * step) % seeds


def _mix(x: int) -> int:
    """Return fmix32 of MurmurHash3."""
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        x = (x ^ x >> shift) * factor & MASK
    return x ^ x >> 16


def usual_spp(pixels: int, total: int | None = None, most: int = LANES) -> int:
    """Return the samples per pixel of a pass over so many pixels: a power of two, and at most LANES samples in all.

    `total`: samples per pixel of the render, None if unknown. `most`: samples per pixel of the pass.
    """
    large = min((total or 0) // MANY, LARGE_LANES // pixels)
    spp = min(max(LEAST_SPP, LEAST_LANES // pixels, large), LANES // pixels, most)
    return 1 << max(0, spp.bit_length() - 1)


@dataclass(frozen=True)
class PassPlan:
    """Passes of `spp` samples per pixel each, and a last one of fewer if `total` is not a multiple of `spp`.

    `total`: samples per pixel of the render; None if only another limit ends it.
    """

    spp: int
    total: int | None

    @property
    def full_passes(self) -> int | None:
        """Number of passes with `spp` samples; None if unknown in advance."""
        return None if self.total is None else self.total // self.spp

    @property
    def passes(self) -> int | None:
        """Number of all passes; None if unknown in advance."""
        return None if self.total is None else -(-self.total // self.spp)

    @property
    def rest(self) -> int:
        """Samples per pixel of a last pass that has fewer than `spp`; 0 if there is none."""
        return 0 if self.total is None else self.total % self.spp


def plan_passes(
    pixels: int,
    total: int | None,
    pass_spp: int | None,
    rounded: Callable[[int], int],
    *,
    moments: bool,
    most: int = LANES,
) -> PassPlan:
    """Return the passes of a render over so many pixels.

    `total`: samples per pixel of the render, None if unknown. `pass_spp`: samples per pixel of a pass, if given;
    otherwise `most` is their limit. `rounded`: rounds a number of samples up as the sampler does. `moments`: whether
    second moments within a pass are known. Without them, a render of few samples has FEW passes, for their spread.
    ValueError for a `pass_spp` that the sampler does not support.
    """
    spp = pass_spp or usual_spp(pixels, total, most)
    if min(spp, total or spp) * pixels > MASK:
        raise ValueError(f"{spp} samples per pixel in a pass of {pixels} pixels; expected up to 2³² − 1 samples in all")
    if pass_spp and rounded(pass_spp) != pass_spp:
        raise ValueError(f"{pass_spp} samples per pixel in a pass; the sampler supports {rounded(pass_spp)}")
    if total and not pass_spp and not moments:
        spp = min(spp, max(1, total // FEW))
    while spp > 1 and rounded(spp) != spp:
        spp -= 1
    spp = rounded(spp)  # may be more than 1: some samplers support no fewer than 4
    if total and (rest := total % spp):
        total += rounded(rest) - rest
    return PassPlan(spp, total)


def next_stop(passes: int) -> int:
    """Return the first of 8, 12, 16, 24, 32, 48 … above `passes`. Only there an estimated error may end a render.

    The stops are few because an estimate that is evaluated often falls below a limit by chance at some time.
    """
    stop = FEW
    while stop <= passes:
        stop = stop * 3 // 2 if stop & (stop - 1) == 0 else stop // 3 * 4
    return stop
