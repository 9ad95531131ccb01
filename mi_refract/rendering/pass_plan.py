"""How a render is cut into passes, and which seed each has: by its film and the samples asked for, nothing else.

    seed(s, p) = s ⊕ mix(p),    mix: the finaliser of MurmurHash3 on 32 bits, a bijection with mix(0) = 0

For one s all passes have different seeds, for one p all s have; and pass 0 has the seed that was given. In scalar
variants Mitsuba gives pixel k of N the random numbers of sequence seed · N + k, modulo 2³². There

    seed(s, p) = (mix(s) + p) mod M,    M = ⌊2³²/N⌋

so that no two of up to M passes share a sequence; of two renders some passes may be the same, by chance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

LANES = 2**24  # samples of a pass, at most, unless one sample per pixel is more
# A pass costs about 12 ms beside its samples, 1 or 2 % of 2²¹ of them, and its sums as much as a quarter of a sample in
# every pixel. A render of many samples has fewer and larger passes, but at least MANY.
LEAST_LANES, LEAST_SPP = 2**21, 4
LARGE_LANES, MANY = 2**23, 16
# Of the first passes where the error ends a render: a pass takes twice the 12 ms then, and eight are soon there.
FIRST_LANES = 2**15
FEW = 8  # passes: with fewer the spread between them says little
MASK = 2**32 - 1


def seed_of(seed: int, number: int) -> int:
    """The seed of pass `number` of a render with this seed, both from 0 to 2³² − 1."""
    return seed ^ _mix(number)


def scalar_seed_of(seed: int, number: int, pixels: int) -> int:
    """The same in scalar variants, for a film of so many pixels. ValueError where passes would repeat."""
    if number >= (most := (MASK + 1) // pixels):
        raise ValueError(
            f"pass {number} of {pixels} pixels; scalar variants support up to {most}; use a larger --pass-spp"
        )
    return (_mix(seed) + number) % most


def _mix(x: int) -> int:
    """MurmurHash3's fmix32."""
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        x = (x ^ x >> shift) * factor & MASK
    return x ^ x >> 16


def usual_spp(pixels: int, total: int | None = None, most: int = LANES) -> int:
    """Samples per pixel of a pass over so many pixels: a power of two, and no more than LANES samples in all.

    `total`: those of the render, where that is known. `most`: of the pass.
    """
    large = min((total or 0) // MANY, LARGE_LANES // pixels)
    wanted = min(max(LEAST_SPP, LEAST_LANES // pixels, large), LANES // pixels, most)
    return 1 << max(0, wanted.bit_length() - 1)


@dataclass(frozen=True)
class PassPlan:
    """Passes of `spp` samples per pixel each, and a last one of fewer where `total` is no multiple.

    `total`: samples per pixel in all; None where another limit ends the render.
    """

    spp: int
    total: int | None

    @property
    def full_passes(self) -> int | None:
        """How many passes have `spp` samples; None where that is not known before."""
        return None if self.total is None else self.total // self.spp

    @property
    def passes(self) -> int | None:
        """How many passes there are; None where that is not known before."""
        return None if self.total is None else -(-self.total // self.spp)

    @property
    def rest(self) -> int:
        """Samples per pixel of the last pass, where it has fewer; else 0."""
        return 0 if self.total is None else self.total % self.spp


def plan_passes(
    pixels: int,
    total: int | None,
    asked: int | None,
    rounded: Callable[[int], int],
    *,
    moments: bool,
    most: int = LANES,
) -> PassPlan:
    """The passes of a render.

    `asked`: samples per pixel of a pass, where the user says; `most`: at most, where nobody does. `rounded`: what a
    sampler makes of a number of samples, which it may round up. `moments`: whether second moments within a pass are
    known. Where they are not, a render of few samples is cut into FEW passes, for their spread. ValueError for a pass
    that the sampler does not take.
    """
    spp = asked or usual_spp(pixels, total, most)
    if min(spp, total or spp) * pixels > MASK:
        raise ValueError(f"{spp} samples per pixel in a pass of {pixels} pixels; expected up to 2³² − 1 samples in all")
    if asked and rounded(asked) != asked:
        raise ValueError(f"{asked} samples per pixel in a pass; the sampler supports {rounded(asked)}")
    if total and not asked:
        spp = spp if moments else min(spp, max(1, total // FEW))
    while spp > 1 and rounded(spp) != spp:
        spp -= 1
    spp = rounded(spp)  # which may be more than one: some samplers take no fewer than 4
    if total and (rest := total % spp):
        total += rounded(rest) - rest
    return PassPlan(spp, total)


def next_stop(passes: int) -> int:
    """The first of 8, 12, 16, 24, 32, 48 … that is more than `passes`: where an estimated error may end a render.

    The fewer looks at an estimate, the less its chance: what is stopped where it first falls short is too good.
    """
    stop = FEW
    while stop <= passes:
        stop = stop * 3 // 2 if stop & (stop - 1) == 0 else stop // 3 * 4
    return stop
