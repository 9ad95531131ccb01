"""A pilot before a render: it measures a few candidates for the settings of the scene, and chooses.

    cost = σ² t

σ² is the variance of a pixel's mean over the samples of one pass, t the time that they take. Two passes of some pixels,
spread over the image, give an estimate of σ² for each pixel, without the pixel's own brightness. All candidates render
the same pixels with the same seeds. Each does more than the one before it, for less noise in more time: the scene's own
settings; a stratified sampler and `refract_path`; both lobes of glass followed; lamps traced, too. The first whose cost
is at most MARGIN times the least is chosen: what is alike stays plain.

A few pixels may meet none of the rare and bright samples that make the noise. Three facts stand in for them:

- What does more has no more noise: σ² of one without lamps is at least that of the next.
- The last two have the same random numbers, and differ by the light x of lamps that path tracing finds. Its mean μ over
  the image is known from the lamps, and the mean size of what is found from a few finds, so

      σ² = σ²(all else) + σ²(x),    σ²(x) = μ E[x²]/E[x]

- Of n passes that have found less than half of μ, the rest is in finds that are rarer than 1/n: σ²(x) ≥ (μ − x̄)² n.

A pass of the pilot has as many samples as one of the render, as strata depend on it; fewer, LEAST_SPP at least, where
that would be few pixels. The pilot's samples are not in the image, so it stays unbiased.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refract.plugins import inspect, missing_light, scene_parser
from mi_refract.plugins.scene_parser import ParsedScene

from .pass_plan import MASK, PassPlan, seed_of
from .pass_sums import Doubles
from .render_pass import PassRenderer, quiet, samples_of_pixels, set_spp
from .render_settings import AUTO, DEFAULTS, OWN, SAMPLERS, Settings, integrator_node, own_settings, settings_text

SHARE = 0.05  # of the render, which the pilot takes at most, unless the least of each candidate takes more
AIMED = 0.7  # of that, as times are not known well
OPEN_SAMPLES = 2**20  # of which it takes as much time where the render's number of samples is not known
FIRST = 1 / 6  # of its samples: those of the first batch, which says how many pixels the second may have
LEAST_PIXELS, LEAST_SPP = 32, 16  # of a batch
MOST_SPP = 1 / 2048  # of the pilot's samples, where that is more than LEAST_SPP: else pixels would be few
LARGEST, TIMED = 2**20, 2**18  # samples of a batch, and of one whose time is measured on processors
COPIES = 2  # of a pixel
LIGHT_PATHS = 2**13  # at least, by which those of an image are measured
MARGIN = 1.1  # over the least cost: within it all are alike
SURELY = 1.25  # over the least cost: where the interval of the scene's own may end for them to stay
LOST = 3.0  # over the least cost, after the first batch: less can be by chance, whatever the interval is
FEW = 10  # passes that have found light of lamps: with fewer, two of a pixel may be alike by chance
# Of all depths 0 or 3 cost little more than the best.
PLAIN: Settings = {"integrator": "refract_path", "split_depth": "0", "caustics": "path"}
SPLIT, CAUSTICS = PLAIN | {"split_depth": "3"}, {"integrator": "refract_path", "caustics": "lamp"}
GROUPS, T = 16, 2.13  # of pixels, for the intervals; the 97.5 % point of Student's t of one less
# The relative standard error of the time of a pass.
TIME_ERROR = 0.05
ROUNDING = 1e-5  # of a pixel's brightness: noise that is no more is none


@dataclass(frozen=True)
class Passes:
    """What one candidate did with some pixels: `means`, channels × pixels × COPIES, of a pass each.

    `seconds`: of a pixel in a pass, the light paths for it included. `once`: those of batches, whatever their size, and
    of tracing lamps. Where they are traced, `lamps` is the variance of a pixel in that part of a pass, and `light` its
    brightness, both over the image; else None. `found`: light of lamps in what the candidate before has rendered, as
    `means`, and the variance of such a mean if the samples of a pass were independent.
    """

    means: Doubles
    seconds: float
    lamps: float | None = None
    light: float = 0.0
    once: float = 0.0
    found: Doubles | None = None

    def of(self, pixels: Any) -> Passes:
        """The same for some pixels only."""
        found = None if self.found is None else self.found[:, :, pixels]
        return replace(self, means=self.means[:, pixels], found=found)

    @property
    def took(self) -> float:
        """Seconds, of all."""
        return self.once + self.seconds * float(self.means[0].size)

    def __add__(self, other: Passes) -> Passes:  # noqa: D105
        means, found = np.concatenate([self.means, other.means], 1), self.found
        if found is not None and other.found is not None:
            found = np.concatenate([found, other.found], 2)
        once, seconds = self.once + other.once, min(self.seconds, other.seconds)
        return replace(self, means=means, found=found, seconds=seconds, once=once)


@dataclass(frozen=True)
class Lamps:
    """The lamps' part of an image: a pixel's variance by one light path, its light, and the seconds of a path."""

    variance: float
    light: float
    seconds: float


@dataclass(frozen=True)
class Ratio:
    """The cost of a candidate over that of another, with its 95 % interval, and its two factors."""

    value: float
    low: float
    high: float
    variance: float
    time: float


def variances(passes: dict[str, Passes]) -> dict[str, float]:
    """σ² by candidate, given in their order."""
    values = {name: _between(each.means) + (each.lamps or 0.0) for name, each in passes.items()}
    least, last = 0.0, [*passes][-1]
    names = [*passes][1:] if next(iter(passes)) == OWN else [*passes]
    for name in reversed([name for name in names if passes[name].lamps is None]):
        if not least and (found := passes[last].found) is not None:
            values[name] = _between(passes[last].means) + _of_found(found[0], found[1], passes[last].light)
        least = values[name] = max(values[name], least)
    light = np.mean([each.means.mean() + each.light for each in passes.values()])
    return {name: value + (ROUNDING * light) ** 2 + np.finfo(np.float64).tiny for name, value in values.items()}


def _between(means: Doubles) -> float:
    """The variance of a mean, from the COPIES of pixels."""
    return float(np.square(np.diff(means)).mean()) / 2


def _of_found(means: Doubles, within: Doubles, light: float) -> float:
    """σ²(x) of light of lamps that path tracing has found, where there is `light` of it."""
    mean, count = float(means.mean()), means[0].size
    variance = float(within.mean()) if np.count_nonzero(means.any(0)) < FEW else _between(means)
    value = variance * light / mean if mean > 0 else 0.0
    return max(value, count * (light - mean) ** 2) if mean < light / 2 else value


def ratios(found: dict[str, Passes], of: str) -> dict[str, Ratio]:
    """The cost of each candidate over that of one of them. Intervals are by the jackknife, over groups of pixels."""
    known = np.logical_and.reduce([np.isfinite(each.means).all((0, 2)) for each in found.values()])
    group = np.cumsum(known) % GROUPS

    def over_one(kept: Any) -> Doubles:
        values = variances({name: each.of(kept) for name, each in found.items()})
        return np.array([*values.values()]) / values[of]

    if known.sum() < GROUPS:
        return dict.fromkeys(found, UNKNOWN)
    without = np.log([over_one(known & (group != i)) for i in range(GROUPS)])
    result = {}
    for (name, each), ratio, error in zip(found.items(), over_one(known), without.std(0), strict=True):
        seconds = each.seconds / found[of].seconds
        factor = math.exp(T * math.hypot(math.sqrt(GROUPS - 1) * error, TIME_ERROR * (name != of)))
        value = float(ratio * seconds)
        result[name] = Ratio(value, value / factor, value * factor, float(ratio), seconds)
    return result


UNKNOWN = Ratio(1, 0, math.inf, 1, 1)


def known(costs: dict[str, Ratio]) -> dict[str, Ratio]:
    """The costs without the scene's own where it has less noise than the next: it has not met all of it."""
    (first, own), *others = costs.items()
    if first == OWN and others and own.variance * MARGIN < others[0][1].variance:
        return dict(others)
    return costs


@dataclass(frozen=True)
class Choice:
    """The settings that a pilot has chosen; its seconds, its share of the render, and all costs over that of these."""

    settings: Settings
    figures: dict[str, Any]


def choose(pilot: Pilot) -> Choice:
    """Measure `Pilot.candidates` in two batches; those that cannot win are left out of the second.

    ValueError where no light is seen; RuntimeError of Mitsuba.
    """
    named = {settings_text(settings): settings for settings in pilot.candidates}
    passes = {name: pilot.measure(settings, 0, pilot.first) for name, settings in named.items()}
    if not any(np.nan_to_num(each.means).any() or each.light for each in passes.values()):
        text = f"{pilot.parsed.path}: --settings {AUTO}: the pilot sees no light"
        raise ValueError(f"{text}; expected some, or settings by name")
    *_, before, last = [OWN, *passes]
    costs = known(ratios(passes, last))
    least = min(cost.high for cost in costs.values())
    left = [name for name, cost in costs.items() if cost.low <= LOST * least]
    if last in left[1:] and passes[last].found is not None:  # that is light of the one before
        left = [name for name in passes if name in {*left, before}]
    took, seconds = sum(each.took for each in passes.values()), {name: passes[name].seconds for name in left}
    pixels = int((AIMED * pilot.allowed(min(seconds.values())) - took) / COPIES / sum(seconds.values()))
    more = {name: passes[name] for name in left}
    if len(left) > 1 and pixels >= pilot.first:
        more = {name: passes[name] + pilot.measure(named[name], 1, pixels) for name in left}
        took += sum(more[name].took - passes[name].took for name in left)
    costs = known(ratios(more, left[0]))
    best = min(costs, key=lambda name: costs[name].value)
    alike = [name for name in costs if costs[name].value <= MARGIN * costs[best].value]
    chosen = OWN if OWN in alike and ratios(more, best)[OWN].high <= SURELY else next(n for n in alike if n != OWN)
    table = {name: vars(cost) for name, cost in (ratios(passes, chosen) | ratios(more, chosen)).items()}
    rounded = {name: {key: float(f"{value:.3g}") for key, value in cost.items()} for name, cost in table.items()}
    share = SHARE * took / pilot.allowed(more[chosen].seconds)
    figures = {"seconds": float(f"{took:.3g}"), "share": float(f"{share:.3g}"), "of": chosen, "costs": rounded}
    return Choice(named[chosen], figures)


def lines_of(figures: dict[str, Any]) -> list[str]:
    """A line for each candidate of `Choice.figures`."""
    return [
        f"{name}: {cost['value']:g} × the cost of the chosen settings ({cost['low']:g} to {cost['high']:g}): "
        f"{cost['variance']:g} × the variance, {cost['time']:g} × the time"
        for name, cost in sorted(figures["costs"].items(), key=lambda item: -float(item[1]["value"]))
    ]


class Pilot:
    """Measures candidates for the settings of a scene; `choose` asks it."""

    def __init__(
        self,
        parsed: ParsedScene,
        renderer: PassRenderer,
        plan: Callable[[Callable[[int], int]], PassPlan],
        seconds: float | None = None,
    ) -> None:
        """`parsed`, `renderer`: the scene with its own settings, loaded.

        `plan`: of the passes, given what a sampler makes of a number of samples; `seconds`: of the render, where they
        are limited. ValueError where samples cannot be rendered one by one, and for a sampler that is none of SAMPLERS
        or has no jitter.
        """
        self.parsed, self.renderer, self.plan, self.seconds = parsed, renderer, plan, seconds
        self.own, self.cuda = own_settings(parsed), "cuda" in str(mi.variant())
        self.clock = time.perf_counter if self.cuda else time.thread_time
        what = f"{parsed.path}: --settings {AUTO}"
        if not renderer.moments:
            expected = "an integrator of samples, a film without a border, and a JIT variant such as llvm_ad_rgb"
            raise ValueError(f"{what}: samples cannot be rendered one by one; expected {expected}")
        unknown = self.own["sampler"] not in SAMPLERS
        fixed = not unknown and "jitter = 0" in str(renderer.scene.sensors()[0].sampler())  # its error is not noise
        if unknown or fixed:
            problem = f"the scene's sampler is {self.own['sampler']}{' without jitter' * fixed}"
            raise ValueError(f"{what}: {problem}; expected {', '.join(SAMPLERS)}, with jitter, or settings by name")
        total = plan(renderer.rounded).total
        self.samples = OPEN_SAMPLES if total is None else SHARE * math.prod(renderer.size) * total
        self._samplers: dict[str, Any] = {}
        self._integrators: dict[str, Any] = {}
        self._fixed: dict[str, float] = {}  # seconds of a batch, whatever its size
        self._lamps: Lamps | None = None  # alike for all candidates that trace them
        self._before: Doubles | None = None  # samples of the candidate that was measured last
        self._once = 0.0  # seconds that it took to measure them, until a batch has them
        self.candidates = self._candidates()
        per_pixel = len(self.candidates) * COPIES * self._sampler({}).sample_count()
        self.first = max(LEAST_PIXELS, int(FIRST * self.samples / per_pixel))

    def _candidates(self) -> list[Settings]:
        """The candidates in their order; only those that trace lamps where all else misses light."""
        node, features = integrator_node(self.parsed, {}), inspect(self.renderer.scene)
        if self.own.get("caustics") == "auto":
            scene = self.renderer.scene
            self.own["caustics"] = scene.integrator().caustics_of(scene, scene.sensors()[0])
        best = self.own | {"sampler": next(filter(self._fits, (*SAMPLERS, self.own["sampler"])))}
        tried = [self.own, best]
        fixed = node is None or any(
            name.startswith("camera_") or (name, value) == ("deterministic", True) for name, _, value in node[3]
        )
        beyond_path = features.absorbing or features.dispersive or features.media  # `path` ignores these
        if not fixed and (self.own["integrator"] == "refract_path" or not beyond_path):
            tried = [self.own, best | PLAIN, *[best | SPLIT] * features.splitting]
            if self._lamps_traceable():
                missing = bool(missing_light(self.renderer.scene))
                tried = [each | CAUSTICS for each in tried[1:]] if missing else [*tried, tried[-1] | CAUSTICS]
        known = DEFAULTS | self.own
        changed = [{name: x for name, x in each.items() if known.get(name) != x} for each in tried]
        return [each for i, each in enumerate(changed) if each not in changed[i + 1 :]]

    def _fits(self, sampler: str) -> bool:
        """Whether a sampler takes as many samples as a pass shall have; the scene's own does, or will be an error."""
        try:
            self._sampler({"sampler": sampler})
        except ValueError:
            return sampler == self.own["sampler"]
        return True

    def _lamps_traceable(self) -> bool:
        scene, integrator = self.renderer.scene, self._integrator(CAUSTICS)
        try:
            return bool(integrator.caustics_of(scene, scene.sensors()[0]) == "lamp")
        except ValueError:
            return False

    def measure(self, settings: Settings, number: int, size: int) -> Passes:
        """Batch `number` of a candidate, of `size` pixels, which are those of all candidates, as its seed is.

        The seeds are those of passes counted down from 2³² − 1, which no render comes to.
        """
        sampler, integrator = self._sampler(settings), self._integrator(settings)
        spp, one_pixel = sampler.sample_count(), np.zeros(COPIES, np.uint32)
        if number == 0:
            with quiet():  # what is missing is said of the settings that are chosen
                for _ in range(2):  # the first compiles
                    _, self._fixed[settings_text(settings)] = self._render(
                        integrator, sampler, one_pixel, 0, alone=True
                    )
        size = max(1, min(size, LARGEST // (COPIES * spp)))
        places = np.arange(size) + np.random.default_rng([self.renderer.seed, number]).random(size)
        pixels = np.repeat((places * (math.prod(self.renderer.size) / size)).astype(np.uint32), COPIES)
        seed, alone = seed_of(self.renderer.seed, MASK - number), number == 0 or len(pixels) * spp <= TIMED
        values, took = self._render(integrator, sampler, pixels, seed, alone=alone)
        fixed = min(self._fixed[settings_text(settings)], 0.8 * took)
        values, seconds = values.reshape(len(values), size, COPIES, spp), (took - fixed) / len(pixels)
        means, before, self._before = values.mean(-1), self._before, values
        if not getattr(integrator, "apart", False) or self._lamps is None:
            return Passes(means, seconds, once=fixed)
        paths, lamps, once, self._once = integrator.light_paths * spp, self._lamps, fixed + self._once, 0.0
        found = None
        if before is not None and settings == self.candidates[-1] == self.candidates[-2] | CAUSTICS:
            found = np.stack([(before - values).mean(-1), (before - values).var(-1, ddof=1) / spp])
        variance = lamps.variance / (paths * math.prod(self.renderer.size))  # `paths` for each pixel
        return Passes(means, seconds + paths * lamps.seconds, variance, lamps.light, once, found)

    def allowed(self, seconds: float) -> float:
        """Seconds of the pilot, given those of a pixel in a pass."""
        threads = 1 if self.cuda else dr.thread_count()
        limit = math.inf if self.seconds is None else SHARE * self.seconds * threads
        return min(limit, self.samples / int(self._sampler({}).sample_count()) * seconds)

    def _sampler(self, settings: Settings) -> Any:
        """A sampler with as many samples as a pass of the render, or fewer where that would be few pixels."""
        name = settings.get("sampler", self.own["sampler"])
        if name not in self._samplers:
            own = name == self.own["sampler"]
            sampler = self.renderer.scene.sensors()[0].sampler().clone() if own else mi.load_dict({"type": name})
            most = max(LEAST_SPP, int(MOST_SPP * self.samples))
            spp = min(self.plan(lambda spp: set_spp(sampler, spp)).spp, most)
            while spp > 1 and set_spp(sampler, spp) != spp:
                spp -= 1
            self._samplers[name] = sampler
        return self._samplers[name]

    def _integrator(self, settings: Settings) -> Any:
        changed = {name: value for name, value in settings.items() if name != "sampler"}
        if not changed:
            return self.renderer.scene.integrator()
        if (name := settings_text(changed)) not in self._integrators:
            node = integrator_node(self.parsed, changed)
            assert node is not None
            self._integrators[name] = scene_parser.restore(self.parsed.path, [node]).load()
        return self._integrators[name]

    def _render(self, integrator: Any, sampler: Any, pixels: Any, seed: int, *, alone: bool) -> tuple[Doubles, float]:
        """The samples' colours, channels × samples, and the seconds of the kernel: ∞ where they are not measured.

        On processors the time is that of this thread where it renders `alone`: beside others it would wait for work,
        and for other programs.
        """
        values = samples_of_pixels(self.renderer, integrator, sampler, pixels, seed)
        with self._one_thread(alone):
            before = self.clock()
            dr.eval(values)
            dr.sync_thread()
            took = self.clock() - before if alone or self.cuda else math.inf
        if hasattr(integrator, "end_render"):
            if getattr(integrator, "apart", False) and self._lamps is None:
                self._trace_lamps(integrator)
            integrator.end_render()
        return np.array([np.array(value) for value in values], np.float64), took

    @contextlib.contextmanager
    def _one_thread(self, alone: bool = True) -> Iterator[None]:
        dr.sync_thread()
        threads = dr.thread_count()
        if alone and not self.cuda:
            dr.set_thread_count(1)
        try:
            yield
        finally:
            dr.sync_thread()
            dr.set_thread_count(threads)

    def _trace_lamps(self, integrator: Any) -> None:
        """Measure the lamps' part of the image."""
        scene, seconds = self.renderer.scene, list[float]()
        paths = min(max(int(self.samples / 8), LIGHT_PATHS), TIMED)
        with self._one_thread():
            # The first trace compiles, and in an empty cache of kernels the second one compiles once more.
            for _ in range(3):
                before = self.clock()
                light, variance = integrator.caustic_image(
                    scene, scene.sensors()[0], self.renderer.seed, 1, self.renderer.channels, squares=True, paths=paths
                )
                seconds.append(self.clock() - before)
        self._once = seconds[-1]
        variance, light = (float(np.nan_to_num(x).mean()) for x in (variance, light))
        self._lamps = Lamps(variance * paths, light, self._once / paths)
