"""Random numbers for paths, also for paths that split; and the choice of an emitter."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr

from mi_refract.numerics import Count, Interaction, Mask, Number, Point2, Sampler, Scene, Spectrum, Variant

ONE = 1 - 2.0**-24  # the largest float32 below 1
GOLDEN = 0x9E3779B9  # 2³² over the golden ratio
# Mitsuba's samplers that stratify the samples of a pixel. They permute the strata of each dimension by seeds with
# constant differences, so the permutations of two dimensions may be dependent: study `samplers`.
STRATIFIED = "MultijitterSampler", "StratifiedSampler", "LowDiscrepancySampler", "OrthogonalSampler"


class SceneSampler:
    """The scene's own sampler. Keys are ignored: numbers come in the order of the calls."""

    def next_1d(self, sampler: Sampler, key: Count) -> Number:
        """Return a number in [0, 1)."""
        return sampler.next_1d()

    def next_2d(self, sampler: Sampler, key: Count) -> Point2:
        """Return a point in [0, 1)²."""
        return sampler.next_2d()


class IndependentNumbers:
    """Independent random numbers for scalar variants. Keys are ignored: numbers come in the order of the calls."""

    def __init__(self, v: Variant, seed: int) -> None:
        """`v`: the variant's module."""
        self.v, self.generator = v, v.PCG32(initstate=seed)

    def next_1d(self, sampler: Sampler, key: Count) -> Number:
        """Return a number in [0, 1)."""
        return self.generator.next_float32()

    def next_2d(self, sampler: Sampler, key: Count) -> Point2:
        """Return a point in [0, 1)²."""
        return self.v.Point2f(*self.independent(key, 2))

    def independent(self, key: Count, count: int) -> list[Number]:
        """Return `count` numbers in [0, 1)."""
        return [self.generator.next_float32() for _ in range(count)]


def seeds_of(v: Variant, sampler: Sampler) -> Count:
    """Return a seed for each lane, made of a point of the sampler."""
    return v.sample_tea_32(*(dr.reinterpret_array(v.UInt32, x) for x in dr.detach(sampler.next_2d())))[0]


def seed_of_pass(v: Variant, sampler: Sampler, seed: Any, number: Any) -> Count:
    """Return one seed for all lanes of pass `number` of a render with this seed.

    `sampler`: the sensor's, which may have a seed of its own.
    """
    probe, seed, number = sampler.clone(), v.UInt32(seed), v.UInt32(number)
    dr.make_opaque(seed, number)  # data of the kernel: no other kernel for each seed
    probe.seed(seed, 1)
    word = v.sample_tea_32(seed, dr.reinterpret_array(v.UInt32, dr.detach(probe.next_1d())))[0]
    word = v.sample_tea_32(word, number)[0]
    dr.eval(word)
    return word


def mixed(word: Count) -> Count:
    """Return the hash of a word: the finaliser of MurmurHash3."""
    word = (word ^ (word >> 16)) * 0x85EBCA6B
    word = (word ^ (word >> 13)) * 0xC2B2AE35
    return word ^ (word >> 16)


class KeyedMultijitter:
    """Stratified random numbers for the lanes of a wavefront, in which the samples of a pixel are adjacent.

    A Mitsuba sampler counts dimensions in the order of the calls: a path that draws one number more shifts all later
    dimensions. Here a number depends on its key. Each key is a dimension of its own that is stratified over the samples
    of a pixel: correlated multi-jittered sampling (Kensler 2013).

    For camera paths the seed is that of the pass (`seed_of_pass`), or if another integrator calls this one, that of
    its sampler (`seeds_of`), which takes longer.
    """

    def __init__(self, v: Variant, seed: Count, lanes: int, count: int) -> None:
        """`v`: the variant's module. `seed`: one for all lanes, or one a lane. `count`: samples of a pixel."""
        self.v = v
        # A symbolic loop cannot read other lanes: each lane counts as a pixel.
        self.count = count if lanes % count == 0 and not dr.flag(dr.JitFlag.SymbolicScope) else 1
        self.rows = next(r for r in range(math.isqrt(self.count), 0, -1) if self.count % r == 0)
        self.columns = self.count // self.rows
        self.lane = dr.arange(v.UInt32, lanes)
        pixel = self.lane // self.count
        self.index = self.lane - pixel * self.count
        if self.count > 1 and dr.width(seed) > 1:
            seed = dr.gather(v.UInt32, seed, self.lane - self.index)  # the seed of the pixel's first lane
        self.pixel = v.sample_tea_32(pixel, seed)[0]
        self.sample = v.sample_tea_32(self.lane, self.pixel)[0]

    def next_1d(self, sampler: Sampler, key: Count) -> Number:
        """Return a number in [0, 1). The n samples of a pixel with one key lie in n equal intervals, one in each."""
        permutation = mixed(self.pixel + self.v.UInt32(key) * GOLDEN)
        stratum = self._permuted(self.index, self.count, permutation)
        return self._placed(stratum, self._unit(mixed(self.sample ^ permutation)), self.count)

    def next_2d(self, sampler: Sampler, key: Count) -> Point2:
        """Return a point in [0, 1)², stratified in rows × columns cells, and in x and y each over all samples."""
        v, cell_seed = self.v, mixed(self.pixel + self.v.UInt32(key) * GOLDEN)
        # Seeds with a constant difference give dependent permutations. So each seed is a hash of its own.
        row_seed = mixed(cell_seed + GOLDEN)
        column_seed = mixed(row_seed + GOLDEN)
        cell = self._permuted(self.index, self.count, cell_seed)
        row = cell // self.columns
        column = cell - row * self.columns
        # Cells are divided likewise: no two samples share a fine row or a fine column.
        inner_row = self._permuted(row, self.rows, row_seed)
        inner_column = self._permuted(column, self.columns, column_seed)
        x, y = (self._unit(mixed(self.sample ^ seed)) for seed in (row_seed, column_seed))
        x, y = self._placed(inner_row, x, self.rows), self._placed(inner_column, y, self.columns)
        return v.Point2f(self._placed(column, x, self.columns), self._placed(row, y, self.rows))

    def independent(self, key: Count, count: int) -> list[Number]:
        """Return `count` ≤ 4 numbers in [0, 1) without stratification, in a fraction of the time."""
        v = self.v
        # Lanes and keys are small numbers in a row. After 4 rounds, the default, numbers of two keys are dependent.
        calls = [v.sample_tea_32(self.lane, self.pixel + key + i, rounds=8) for i in range(0, count, 2)]
        return [self._unit(word) for words in calls for word in words][:count]

    def _permuted(self, index: Count, count: int, seed: Count) -> Count:
        """Return the place of an index in a permutation of `count` ≤ 2³¹ numbers.

        Mitsuba's function adds the seed at the end, modulo 2³² before it is modulo `count`, so the seed is below 2³¹.
        """
        return self.v.permute_kensler(index, count, seed & 0x7FFFFFFF)

    def _unit(self, word: Count) -> Number:
        """Return the upper 24 bits as a number in [0, 1)."""
        return self.v.Float(word >> 8) * 2.0**-24

    def _placed(self, stratum: Count, x: Number, count: int) -> Number:
        """Return x, in [0, 1), mapped to a stratum of `count`."""
        return dr.minimum((self.v.Float(stratum) + x) * (1 / count), ONE)


class SceneEmitters:
    """Emitter sampling by Mitsuba, of all emitters."""

    def __init__(self, v: Variant, scene: Scene) -> None:
        """`v`: the variant's module."""
        self.scene = scene

    def sample(self, si: Interaction, sample: Point2, active: Mask) -> tuple[Interaction, Spectrum]:
        """Return a direction sample toward an emitter, and radiance / density; occlusion is not tested."""
        direction: tuple[Interaction, Spectrum] = self.scene.sample_emitter_direction(si, sample, False, active)
        return direction

    def pdf(self, reference: Interaction, ds: Interaction, active: Mask) -> Number:
        """Return the density per solid angle, seen from `reference`, with which `sample` returns `ds`."""
        return self.scene.pdf_emitter_direction(reference, ds, active)


class NonConstantEmitters:
    """Emitter sampling of all emitters but a constant environment, in proportion to their sampling weights.

    Light that is the same from all directions adds little noise if only the BSDF is sampled: only occluders cause any.
    Sampling it as an emitter would leave fewer samples for the other emitters.
    """

    def __init__(self, v: Variant, scene: Scene) -> None:
        """`v`: the variant's module."""
        self.v, self.vectorised, emitters = v, dr.is_jit_v(v.Float), scene.emitters()
        lamps = [i for i, emitter in enumerate(emitters) if not emitter.is_environment()]
        weights = [0.0 if emitter.is_environment() else float(emitter.sampling_weight()) for emitter in emitters]
        self.total = sum(weights)
        if not self.total:  # then `sample` and `pdf` are not called
            return
        self.only = lamps[0] if len(lamps) == 1 else None
        self.emitters = scene.emitters_dr() if self.vectorised else emitters
        if self.only is None and self.vectorised:
            # Not of the list, nor a DiscreteDistribution: a frozen function cannot record their memory.
            lit = dr.select(self.emitters.is_environment(), 0, self.emitters.sampling_weight())
            self.last, self.sums = len(emitters) - 1, dr.cumsum(lit)
        elif self.only is None:
            self.choice = v.DiscreteDistribution(weights)

    def _choose(self, x: Number, active: Mask) -> tuple[Count, Number, Number]:
        """Return the number of a lamp among the emitters, its probability, and x as a new number in [0, 1)."""
        v = self.v
        if self.only is not None:
            return v.UInt32(self.only), v.Float(1), x
        if not self.vectorised:
            index, x, probability = self.choice.sample_reuse_pmf(x, active)
            return index, probability, x

        def sum_at(index: Count, active: Mask) -> Number:
            return dr.gather(v.Float, self.sums, index, active)

        x = x * sum_at(v.UInt32(self.last), active)
        index = dr.binary_search(0, self.last, lambda i: sum_at(i, active) <= x)
        below = sum_at(index - 1, active & (index > 0))
        weight = sum_at(index, active) - below
        x = dr.select(active, (x - below) / dr.select(active, weight, 1), 0)
        return index, weight / self.total, dr.minimum(x, ONE)

    def sample(self, si: Interaction, sample: Point2, active: Mask) -> tuple[Interaction, Spectrum]:
        """Return a direction sample as `SceneEmitters.sample` does."""
        v, (index, probability, x) = self.v, self._choose(sample.x, active)
        sample = v.Point2f(x, sample.y)
        emitter = dr.gather(v.EmitterPtr, self.emitters, index, active) if self.vectorised else self.emitters[index]
        ds, radiance = emitter.sample_direction(si, sample, active)
        ds.pdf *= probability
        return ds, radiance / probability

    def pdf(self, reference: Interaction, ds: Interaction, active: Mask) -> Number:
        """Return the density as `SceneEmitters.pdf` does; 0 for the environment."""
        if not self.vectorised and (ds.emitter is None or ds.emitter.is_environment() or not active):
            return 0.0
        lamp = active & (ds.emitter.is_environment() ^ True)
        pdf = ds.emitter.pdf_direction(reference, ds, lamp) * ds.emitter.sampling_weight() / self.total
        return dr.select(lamp, pdf, 0)
