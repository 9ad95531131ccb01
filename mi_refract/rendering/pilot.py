"""A pilot before a render: it measures a few candidates for the settings of the scene, and chooses one.

    cost = σ² t

σ² is the variance of a pixel's mean over the samples of one pass, t the time that these samples take. Some pixels,
spread over the image, are rendered in two passes, whose difference gives σ² without knowing the mean of the pixel. All
candidates render the same pixels with the same seeds. Each candidate takes more time than the one before it, for less
noise: the scene's own settings; a stratified sampler and `refract_path`; both lobes of glass followed; lamps traced,
too. The pilot chooses the first candidate whose cost is at most MARGIN times the least: the simplest of similar ones.

A few pixels may miss the rare and bright samples that make most of the noise. Three facts make up for that:

- A candidate has no less noise than the next one: σ² of a candidate without lamps is at least that of the next.
- The last two candidates have the same random numbers, and differ by the light x of lamps that path tracing finds. Its
  mean μ over the image is known from tracing the lamps, and E[x²]/E[x] is known from a few samples with such light, so

      σ² = σ²(all else) + σ²(x),    σ²(x) = μ E[x²]/E[x]

- If n passes have found less than half of μ, the rest is in samples that are rarer than 1/n: σ²(x) ≥ (μ − x̄)² n.

A pass of the pilot has as many samples as one of the render, because strata depend on their number. It has fewer, but
at least LEAST_SPP, where too few pixels would be measured. The image contains no samples of the pilot, so it stays
unbiased.
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
from .render_pass import PassRenderer, forgetting, quiet, samples_of_pixels, set_spp
from .render_settings import AUTO, DEFAULTS, OWN, SAMPLERS, Settings, integrator_node, own_settings, settings_text

SHARE = 0.05  # largest share of the render's time that the pilot takes, unless the smallest batches take more
PLANNED = 0.7  # share of the allowed time that is planned, because times are not known well
OPEN_SAMPLES = 2**20  # samples of the pilot if the render's number of samples is not known
FIRST = 1 / 6  # share of the pilot's samples in the first batch, whose times determine the size of the second
LEAST_PIXELS, LEAST_SPP = 32, 16  # of a batch
MOST_SPP = 1 / 2048  # largest share of the pilot's samples in one pass of a pixel, unless LEAST_SPP is more
LARGEST, TIMED = 2**20, 2**18  # most samples of a batch, and of a batch whose time is measured on processors
COPIES = 2  # passes of each pixel
LIGHT_PATHS = 2**13  # that measure the light of lamps, at least
MARGIN = 1.1  # over the least cost: candidates within it are similar
SURELY = 1.25  # over the least cost: the scene's own settings are kept only if their interval ends below
LOST = 3.0  # over the least cost, after the first batch: smaller differences may be chance, whatever the interval is
FEW_FINDS = 10  # passes that have found light of lamps: with fewer, two passes of a pixel may be alike by chance
# Of all split depths, the better one of 0 and 3 costs little more than the best.
PLAIN: Settings = {"integrator": "refract_path", "split_depth": "0", "caustics": "path"}
SPLIT, CAUSTICS = PLAIN | {"split_depth": "3"}, {"integrator": "refract_path", "caustics": "lamp"}
GROUPS, T = 16, 2.13  # groups of pixels for the intervals; 97.5 % point of Student's t with GROUPS − 1 degrees
TIME_ERROR = 0.05  # relative standard error of the time of a pass
ROUNDING = 1e-5  # of a pixel's brightness: smaller noise counts as none


@dataclass(frozen=True)
class Passes:
    """Passes of one candidate over some pixels. `means`: of each pass, channels × pixels × COPIES.

    `seconds`: time of one pixel in one pass, with its light paths. `fixed_seconds`: time that does not depend on the
    number of pixels, with that of measuring the lamps. The others are set only if lamps are traced. `lamp_variance`:
    variance of a pixel in the lamps' part of a pass; `lamp_light`: mean of that part; both over the image.
    `found_light`: light of lamps that the candidate before has found by path tracing, as `means`, and the variance of
    each such mean if the samples of a pass were independent.
    """

    means: Doubles
    seconds: float
    lamp_variance: float | None = None
    lamp_light: float = 0.0
    fixed_seconds: float = 0.0
    found_light: Doubles | None = None

    def of(self, pixels: Any) -> Passes:
        """Return the same for some pixels only."""
        found_light = None if self.found_light is None else self.found_light[:, :, pixels]
        return replace(self, means=self.means[:, pixels], found_light=found_light)

    @property
    def total_seconds(self) -> float:
        """Time of all passes, in seconds."""
        return self.fixed_seconds + self.seconds * float(self.means[0].size)

    def __add__(self, other: Passes) -> Passes:  # noqa: D105
        means, found_light = np.concatenate([self.means, other.means], 1), self.found_light
        if found_light is not None and other.found_light is not None:
            found_light = np.concatenate([found_light, other.found_light], 2)
        seconds, fixed_seconds = min(self.seconds, other.seconds), self.fixed_seconds + other.fixed_seconds
        return replace(self, means=means, found_light=found_light, seconds=seconds, fixed_seconds=fixed_seconds)


@dataclass(frozen=True)
class Lamps:
    """The lamps' part of an image: the variance of a pixel with one light path, its mean, and the seconds of a path."""

    variance: float
    light: float
    seconds: float


@dataclass(frozen=True)
class Ratio:
    """The cost of a candidate over that of another, with its 95 % interval, and the ratios of variance and time."""

    value: float
    low: float
    high: float
    variance: float
    time: float


def variances(passes: dict[str, Passes]) -> dict[str, float]:
    """Return σ² of each candidate; `passes`: of the candidates, in their order."""
    values = {name: _variance(measured.means) + (measured.lamp_variance or 0.0) for name, measured in passes.items()}
    names = [*passes][1:] if next(iter(passes)) == OWN else [*passes]
    last = passes[[*passes][-1]]
    least = 0.0
    for name in reversed([name for name in names if passes[name].lamp_variance is None]):
        if not least and last.found_light is not None:
            means, independent = last.found_light
            values[name] = _variance(last.means) + _found_variance(means, independent, last.lamp_light)
        least = values[name] = max(values[name], least)
    brightness = np.mean([measured.means.mean() + measured.lamp_light for measured in passes.values()])
    floor = (ROUNDING * brightness) ** 2 + np.finfo(np.float64).tiny
    return {name: value + floor for name, value in values.items()}


def _variance(means: Doubles) -> float:
    """Return the variance of a mean, from the COPIES of pixels."""
    return float(np.square(np.diff(means)).mean()) / 2


def _found_variance(means: Doubles, independent: Doubles, light: float) -> float:
    """Return σ²(x) of lamps' light that path tracing found; `means`, `independent`: of `found_light`; `light`: μ."""
    mean, count = float(means.mean()), means[0].size
    variance = float(independent.mean()) if np.count_nonzero(means.any(0)) < FEW_FINDS else _variance(means)
    value = variance * light / mean if mean > 0 else 0.0
    return max(value, count * (light - mean) ** 2) if mean < light / 2 else value


def ratios(measured: dict[str, Passes], reference: str) -> dict[str, Ratio]:
    """Return the cost of each candidate over that of `reference`. Intervals are by the jackknife, over pixel groups."""
    finite = np.logical_and.reduce([np.isfinite(passes.means).all((0, 2)) for passes in measured.values()])
    group = np.cumsum(finite) % GROUPS

    def variance_ratios(pixels: Any) -> Doubles:
        values = variances({name: passes.of(pixels) for name, passes in measured.items()})
        return np.array([*values.values()]) / values[reference]

    if finite.sum() < GROUPS:
        return dict.fromkeys(measured, UNKNOWN)
    without = np.log([variance_ratios(finite & (group != i)) for i in range(GROUPS)])
    costs = {}
    for (name, passes), variance, error in zip(measured.items(), variance_ratios(finite), without.std(0), strict=True):
        seconds = passes.seconds / measured[reference].seconds
        factor = math.exp(T * math.hypot(math.sqrt(GROUPS - 1) * error, TIME_ERROR * (name != reference)))
        value = float(variance * seconds)
        costs[name] = Ratio(value, value / factor, value * factor, float(variance), seconds)
    return costs


UNKNOWN = Ratio(1, 0, math.inf, 1, 1)


def plausible(costs: dict[str, Ratio]) -> dict[str, Ratio]:
    """Return the costs without those of the scene's own settings if these have less noise than the next candidate.

    Then they have missed some of the noise.
    """
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
    """Measure `Pilot.candidates` in two batches, and return the choice. The second omits candidates that cannot win.

    ValueError if the pilot sees no light; RuntimeError of Mitsuba.
    """
    candidates = {settings_text(settings): settings for settings in pilot.candidates}
    first = {name: pilot.measure(settings, 0, pilot.first_pixels) for name, settings in candidates.items()}
    if not any(np.nan_to_num(passes.means).any() or passes.lamp_light for passes in first.values()):
        text = f"{pilot.parsed.path}: --settings {AUTO}: the pilot sees no light"
        raise ValueError(f"{text}; expected some, or settings by name")
    *_, before_last, last = [OWN, *first]
    costs = plausible(ratios(first, last))
    least = min(cost.high for cost in costs.values())
    left = [name for name, cost in costs.items() if cost.low <= LOST * least]
    if last in left[1:] and first[last].found_light is not None:  # `found_light` is measured with the candidate before
        left = [name for name in first if name in {*left, before_last}]
    spent, seconds = sum(passes.total_seconds for passes in first.values()), [first[name].seconds for name in left]
    pixels = int((PLANNED * pilot.allowed(min(seconds)) - spent) / COPIES / sum(seconds))
    measured = {name: first[name] for name in left}
    if len(left) > 1 and pixels >= pilot.first_pixels:
        measured = {name: first[name] + pilot.measure(candidates[name], 1, pixels) for name in left}
        spent += sum(measured[name].total_seconds - first[name].total_seconds for name in left)
    costs = plausible(ratios(measured, left[0]))
    best = min(costs, key=lambda name: costs[name].value)
    similar = [name for name in costs if costs[name].value <= MARGIN * costs[best].value]
    if OWN in similar and ratios(measured, best)[OWN].high <= SURELY:
        chosen = OWN
    else:
        chosen = next(name for name in similar if name != OWN)
    table = {name: vars(cost) for name, cost in (ratios(first, chosen) | ratios(measured, chosen)).items()}
    rounded = {name: {key: float(f"{value:.3g}") for key, value in cost.items()} for name, cost in table.items()}
    share = SHARE * spent / pilot.allowed(measured[chosen].seconds)
    figures = {"seconds": float(f"{spent:.3g}"), "share": float(f"{share:.3g}"), "of": chosen, "costs": rounded}
    return Choice(candidates[chosen], figures)


def lines_of(figures: dict[str, Any]) -> list[str]:
    """Return a line for each candidate of `Choice.figures`."""
    return [
        f"{name}: {cost['value']:g} × the cost of the chosen settings ({cost['low']:g} to {cost['high']:g}): "
        f"{cost['variance']:g} × the variance, {cost['time']:g} × the time"
        for name, cost in sorted(figures["costs"].items(), key=lambda item: -float(item[1]["value"]))
    ]


class Pilot:
    """Measures candidates for the settings of a scene, for `choose`."""

    def __init__(
        self,
        parsed: ParsedScene,
        renderer: PassRenderer,
        plan: Callable[[Callable[[int], int]], PassPlan],
        seconds: float | None = None,
    ) -> None:
        """`parsed`, `renderer`: the scene with its own settings, loaded.

        `plan`: returns the passes for a function that rounds a number of samples as a sampler does. `seconds`: of the
        render, if limited. ValueError if samples cannot be rendered one by one, for a sampler that is none of SAMPLERS,
        and for one without jitter.
        """
        self.parsed, self.renderer, self.plan, self.seconds = parsed, renderer, plan, seconds
        self.own, self.cuda = own_settings(parsed), "cuda" in str(mi.variant())
        self.clock = time.perf_counter if self.cuda else time.thread_time
        what = f"{parsed.path}: --settings {AUTO}"
        if not renderer.moments:
            expected = "an integrator of samples, a film without a border, and a JIT variant such as llvm_ad_rgb"
            raise ValueError(f"{what}: samples cannot be rendered one by one; expected {expected}")
        if self.own["sampler"] not in SAMPLERS or not renderer.jitter:  # without jitter its error is not noise
            problem = f"the scene's sampler is {self.own['sampler']}{' without jitter' * (not renderer.jitter)}"
            raise ValueError(f"{what}: {problem}; expected {', '.join(SAMPLERS)}, with jitter, or settings by name")
        total = plan(renderer.rounded).total
        # The pilot takes as much time as rendering so many samples.
        self.samples = OPEN_SAMPLES if total is None else SHARE * math.prod(renderer.size) * total
        self._samplers: dict[str, Any] = {}
        self._integrators: dict[str, Any] = {}
        self._fixed_seconds: dict[str, float] = {}  # of a batch of any size, by settings
        self._lamps: Lamps | None = None  # the same for all candidates that trace lamps
        self._lamp_seconds = 0.0  # time of measuring the lamps; 0 once a batch includes it
        self._previous: Doubles | None = None  # samples of the last batch that was measured
        self.candidates = self._candidates()
        per_pixel = len(self.candidates) * COPIES * self._sampler({}).sample_count()
        self.first_pixels = max(LEAST_PIXELS, int(FIRST * self.samples / per_pixel))

    def _candidates(self) -> list[Settings]:
        """Return the candidates in their order; only those that trace lamps where the others miss light."""
        node, features = integrator_node(self.parsed, {}), inspect(self.renderer.scene)
        if self.own.get("caustics") == "auto":
            scene = self.renderer.scene
            self.own["caustics"] = scene.integrator().caustics_of(scene, scene.sensors()[0])
        best_sampler = self.own | {"sampler": next(filter(self._fits, (*SAMPLERS, self.own["sampler"])))}
        candidates = [self.own, best_sampler]
        fixed = node is None or any(
            name.startswith("camera_") or (name, value) == ("deterministic", True) for name, _, value in node[3]
        )
        beyond_path = features.absorbing or features.dispersive or features.media  # `path` ignores these
        if not fixed and (self.own["integrator"] == "refract_path" or not beyond_path):
            candidates = [self.own, best_sampler | PLAIN, *[best_sampler | SPLIT] * features.splitting]
            if self._lamps_traceable():
                if missing_light(self.renderer.scene):
                    candidates = [settings | CAUSTICS for settings in candidates[1:]]
                else:
                    candidates.append(candidates[-1] | CAUSTICS)
        own = DEFAULTS | self.own
        changed = [{name: x for name, x in settings.items() if own.get(name) != x} for settings in candidates]
        return [settings for i, settings in enumerate(changed) if settings not in changed[i + 1 :]]

    def _fits(self, sampler: str) -> bool:
        """Return whether a sampler supports the samples of a pass, or is the scene's own, whose error comes later."""
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
        """Render and return batch `number` of a candidate, of `size` pixels. All candidates have its pixels and seed.

        The seeds are those of passes counted down from 2³² − 1, which no render reaches.
        """
        sampler, integrator = self._sampler(settings), self._integrator(settings)
        spp, one_pixel, text = sampler.sample_count(), np.zeros(COPIES, np.uint32), settings_text(settings)
        if number == 0:
            with quiet():  # warnings of missing light belong to the settings that are chosen
                for _ in range(2):  # the first one compiles
                    _, self._fixed_seconds[text] = self._render(integrator, sampler, one_pixel, 0, alone=True)
        size = max(1, min(size, LARGEST // (COPIES * spp)))
        places = np.arange(size) + np.random.default_rng([self.renderer.seed, number]).random(size)
        pixels = np.repeat((places * (math.prod(self.renderer.size) / size)).astype(np.uint32), COPIES)
        seed, alone = seed_of(self.renderer.seed, MASK - number), number == 0 or len(pixels) * spp <= TIMED
        values, took = self._render(integrator, sampler, pixels, seed, alone=alone)
        fixed_seconds = min(self._fixed_seconds[text], 0.8 * took)
        values, seconds = values.reshape(len(values), size, COPIES, spp), (took - fixed_seconds) / len(pixels)
        means, previous, self._previous = values.mean(-1), self._previous, values
        if not getattr(integrator, "apart", False) or self._lamps is None:
            return Passes(means, seconds, fixed_seconds=fixed_seconds)
        paths, lamps = integrator.light_paths * spp, self._lamps  # `paths` for each pixel
        fixed_seconds, self._lamp_seconds = fixed_seconds + self._lamp_seconds, 0.0
        found_light = None
        if previous is not None and settings == self.candidates[-1] == self.candidates[-2] | CAUSTICS:
            found_light = np.stack([(previous - values).mean(-1), (previous - values).var(-1, ddof=1) / spp])
        variance = lamps.variance / (paths * math.prod(self.renderer.size))
        return Passes(means, seconds + paths * lamps.seconds, variance, lamps.light, fixed_seconds, found_light)

    def allowed(self, seconds: float) -> float:
        """Return the seconds that the pilot may take; `seconds`: of a pixel in a pass."""
        threads = 1 if self.cuda else dr.thread_count()
        limit = math.inf if self.seconds is None else SHARE * self.seconds * threads
        return min(limit, self.samples / int(self._sampler({}).sample_count()) * seconds)

    def _sampler(self, settings: Settings) -> Any:
        """Return a sampler with as many samples as a pass of the render, or fewer where pixels would be too few."""
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
        if not (changed := {name: value for name, value in settings.items() if name != "sampler"}):
            return self.renderer.scene.integrator()
        if (name := settings_text(changed)) not in self._integrators:
            node = integrator_node(self.parsed, changed)
            assert node is not None
            self._integrators[name] = scene_parser.restore(self.parsed.path, [node]).load()
        return self._integrators[name]

    def _render(self, integrator: Any, sampler: Any, pixels: Any, seed: int, *, alone: bool) -> tuple[Doubles, float]:
        """Return the colours of samples, channels × samples, and the seconds of their kernel, ∞ if not measured.

        `alone`: on processors, run the kernel in this thread only, and measure the time of this thread. With more
        threads the time would include waiting for work and for other programs.
        """
        with forgetting(integrator):
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
        scene, most = self.renderer.scene, min(max(int(self.samples / 8), LIGHT_PATHS), TIMED)
        seconds = dict[int, float]()
        with self._one_thread():
            # The first trace compiles. If the cache of kernels is empty, the second one compiles once more. So does the
            # first one of another size.
            for paths in (most, most, 1, 1, most):
                before = self.clock()
                light, variance = integrator.caustic_image(
                    scene, scene.sensors()[0], self.renderer.seed, 1, self.renderer.channels, squares=True, paths=paths
                )
                seconds[paths] = self.clock() - before
        self._lamp_seconds = sum(seconds.values())
        variance, light = (float(np.nan_to_num(x).mean()) for x in (variance, light))
        fixed_seconds = min(seconds[1], 0.8 * seconds[most])
        self._lamps = Lamps(variance * most, light, (seconds[most] - fixed_seconds) / most)
