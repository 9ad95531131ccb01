"""How a render is cut into passes, their seeds, and where it may stop."""

from __future__ import annotations

import pytest

from mi_refract.rendering.pass_plan import LANES, PassPlan, next_stop, plan_passes, scalar_seed_of, seed_of, usual_spp


def exact(spp):
    """A sampler that takes any number of samples."""
    return spp


def square(spp):
    """A sampler that rounds up to a square, as Mitsuba's `stratified`."""
    return next(n * n for n in range(1, 10**6) if n * n >= spp)


def test_the_first_pass_has_the_seed_that_was_given():
    assert [seed_of(seed, 0) for seed in (0, 1, 7, 2**32 - 1)] == [0, 1, 7, 2**32 - 1]


def test_the_seeds_of_a_render_differ_and_so_do_those_of_seeds_that_follow_each_other():
    seeds = [{seed_of(seed, number) for number in range(20000)} for seed in (0, 1, 2)]
    assert [len(each) for each in seeds] == [20000] * 3
    # Of two sets of n random numbers below 2³² n²/2³² = 0.09 are common: more than 3 of them have probability 3e-6.
    assert all(len(a & b) <= 3 for a, b in ((seeds[0], seeds[1]), (seeds[0], seeds[2]), (seeds[1], seeds[2])))
    assert all(0 <= seed < 2**32 for seed in seeds[1])


def test_the_seeds_of_scalar_variants_are_in_a_row():
    most = 2**32 // 3000
    assert [scalar_seed_of(0, p, 3000) for p in (0, 1, most - 1)] == [0, 1, most - 1]
    assert scalar_seed_of(1, 5, 3000) == (0x514E28B7 + 5) % most
    with pytest.raises(ValueError, match="scalar variants support up to"):
        scalar_seed_of(0, most, 3000)


def test_the_finaliser_is_murmurs():
    """Of MurmurHash3's own test: fmix32(1) = 0x514E28B7; Appleby's reference gives the others."""
    assert seed_of(0, 1) == 0x514E28B7
    assert seed_of(5, 1) == 0x514E28B7 ^ 5


@pytest.mark.parametrize("pixels", [1, 48, 64 * 64, 512 * 512, 1920 * 1080, 3840 * 2160, 2**24, 2**26])
def test_a_pass_is_bounded_and_a_power_of_two(pixels):
    spp = usual_spp(pixels)
    assert spp & (spp - 1) == 0
    assert spp == 1 or spp * pixels <= LANES
    assert 2 * spp * pixels > LANES or spp >= 4


def test_a_render_of_many_samples_has_larger_passes_but_at_least_sixteen():
    pixels = 2**18
    assert [usual_spp(pixels, total) for total in (None, 64, 128, 256, 512, 4096)] == [8, 8, 8, 16, 32, 32]
    assert usual_spp(1920 * 1080, 65536) == 4


def test_samples_beyond_whole_passes_are_a_last_one():
    plan = plan_passes(64, 100, 8, exact, moments=True)
    assert (plan.full_passes, plan.rest, plan.passes) == (12, 4, 13)
    assert plan_passes(64, 96, 8, exact, moments=True).rest == 0


def test_without_moments_a_short_render_has_eight_passes():
    assert plan_passes(64, 64, None, exact, moments=False) == PassPlan(8, 64)
    assert plan_passes(64, 5, None, exact, moments=False) == PassPlan(1, 5)
    assert plan_passes(64, 5, None, exact, moments=True).full_passes == 0


def test_a_pass_is_one_that_the_sampler_takes():
    assert plan_passes(2**18, 100, None, square, moments=True) == PassPlan(4, 100)  # 8 would become 9
    assert plan_passes(2**18, 102, 9, square, moments=True) == PassPlan(9, 103)  # 11 × 9, and 3 become 4
    with pytest.raises(ValueError, match="8 samples per pixel in a pass; the sampler supports 9"):
        plan_passes(64, 100, 8, square, moments=True)


def test_a_sampler_may_take_no_fewer_than_four():
    def four(spp):
        return max(4, spp)

    assert plan_passes(64, 16, None, four, moments=False) == PassPlan(4, 16)  # FEW passes would have 2
    assert plan_passes(2**23, 3, None, four, moments=True) == PassPlan(4, 4)


def test_a_pass_has_fewer_than_2_to_the_32_samples():
    with pytest.raises(ValueError, match=r"expected up to 2³² − 1 samples in all"):
        plan_passes(64, None, 2**26, exact, moments=True)
    assert plan_passes(64, 10, 2**26, exact, moments=True).rest == 10


def test_looks_are_few():
    stops = [8]
    while len(stops) < 8:
        stops.append(next_stop(stops[-1]))
    assert stops == [8, 12, 16, 24, 32, 48, 64, 96]
    assert [next_stop(passes) for passes in (0, 7, 8, 9, 95)] == [8, 8, 12, 12, 96]
