"""A pilot before a render: it measures candidates for the settings of the scene on a few pixels, and chooses.

    cost = σ² t

σ² is the variance of a pixel's mean over the samples of one pass, t the time that they take. Two passes of some pixels,
spread over the image, give an estimate of σ² for each pixel, without the pixel's own brightness. All candidates render
the same pixels. So of two of them the ratio of the costs has an interval from what differs by pixel:

    log (σ²/σ'²) ± z s,    s² = Var(v/σ² − v'/σ'²) / n,    v: estimates of the n pixels, σ²: their mean

Candidates of a step run in turn, in batches of twice as many pixels each time; one whose interval, relative to the
cheapest, lies above 1 is dropped. A sampler is measured with as many samples as a pass of the render has, as strata
depend on it; with fewer, 16 at least, where the pilot would be too long. The scene's own settings stay where the best
are not clearly cheaper. The pilot's samples are not in the image, so it stays unbiased.

Light that is traced from lamps (`caustics` of `refract_path`) is measured once for the whole image. What path tracing
has hardly met of it in the pilot's pixels, its variance does not hold: there lamps are traced.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refract.plugins import inspect, missing_light, scene_parser
from mi_refract.plugins.scene_parser import ParsedScene

from .pass_plan import MASK, PassPlan, seed_of
from .pass_sums import Doubles
from .render_pass import PassRenderer, quiet, samples_of_pixels, set_spp
from .render_settings import AUTO, OWN, SAMPLERS, Settings, integrator_node, own_settings, settings_text

SHARE = 0.05  # of the render, which the pilot takes at most, once each candidate has had its first batch
OPEN_SAMPLES = 2**20  # of which it takes as much time where the render's number of samples is not known
LEAST_PIXELS, LEAST_SPP = 128, 16  # of a batch
LARGEST, TIMED = 2**20, 2**16  # samples of a batch, and of one whose time is measured on processors
BATCHES = 8
COPIES = 2  # of a pixel
LEAST_LIGHT_PATHS = 2**14
# The variance of path tracing does not say whether to trace lamps where one pixel has so large a share of it, or where
# path tracing has met less than half of the caustics, if they are so much of the light.
FIREFLY, SEEN = 1 / 3, 0.01
# Standard deviations: of the intervals, 95 % of a normal distribution; and of a difference that decides. Where it is
# none, either choice costs the same.
Z, CLEARLY = 1.96, 0.7
# The relative standard error of the least time of one batch; of k batches it is 1/√k of that.
TIME_ERROR = 0.05
ROUNDING = 1e-5  # of a pixel's brightness: noise that is no more is none
CAUSTICS: Settings = {"integrator": "refract_path", "caustics": "lamp"}
# What is tried, step by step, with the best of the steps before, which is always among them: in each the first that is
# not clearly dearer than the cheapest.
STEPS: tuple[tuple[Settings, ...], ...] = (
    tuple({"sampler": name} for name in SAMPLERS),
    (CAUSTICS,),
    (*({"integrator": "refract_path", "split_depth": str(depth)} for depth in range(4)), {"integrator": "path"}),
)


@dataclass(frozen=True)
class Batch:
    """What one candidate did with some pixels.

    `variance`: of the mean over a pass, estimated for each pixel; `light`: the mean of all; `seconds`: of a pixel in a
    pass; `took`: of all. `caustics`: the mean of the light that is traced from lamps, `all_caustics`: of the image.
    """

    variance: Doubles
    light: float
    seconds: float
    took: float
    caustics: float = 0.0
    all_caustics: float = 0.0


@dataclass(frozen=True)
class Lamps:
    """The lamps' part of an image: by pixel its variance by one light path, and its light; the seconds of a path."""

    variance: Doubles
    light: Doubles
    seconds: float


@dataclass(frozen=True)
class Ratio:
    """The cost of a candidate over that of another, with its interval, and its two factors."""

    value: float
    low: float
    high: float
    variance: float
    time: float


def ratio(batches: list[Batch], others: list[Batch], z: float = Z) -> Ratio:
    """The cost by `batches` over that by `others`, over the batches that both have."""
    count = min(len(batches), len(others))
    ours, theirs = (np.concatenate([batch.variance for batch in each[:count]]) for each in (batches, others))
    # Where no candidate has more noise than that of rounding, they are alike.
    light = np.mean([batch.light for batch in (*batches[:count], *others[:count])])
    least = np.square(ROUNDING * light) + np.finfo(np.float64).tiny
    known = np.isfinite(ours) & np.isfinite(theirs)
    ours, theirs = ours[known] + least, theirs[known] + least
    if not len(ours) or unseen(batches, others) or unseen(others, batches):
        return UNKNOWN
    apart = any(batch.all_caustics for batch in batches) != any(batch.all_caustics for batch in others)
    if apart and max(ours.max() / ours.sum(), theirs.max() / theirs.sum()) > FIREFLY:
        return UNKNOWN
    variance = ours.mean() / theirs.mean()
    spread = (ours / ours.mean() - theirs / theirs.mean()).std() / math.sqrt(len(ours))
    seconds = min(batch.seconds for batch in batches[:count]) / min(batch.seconds for batch in others[:count])
    factor = math.exp(z * math.hypot(spread, 0 if batches is others else TIME_ERROR / math.sqrt(count)))
    value = float(variance * seconds)
    return Ratio(value, value / factor, value * factor, float(variance), float(seconds))


UNKNOWN = Ratio(1, 0, math.inf, 1, 1)


def unseen(batches: list[Batch], others: list[Batch]) -> bool:
    """Whether `others`, by path tracing, do not know their variance, as `batches` have traced lamps.

    They have met less than half of that light, or their pixels have less than half of what a pixel has in the mean.
    """
    count = min(len(batches), len(others))
    ours, theirs = batches[:count], others[:count]
    whole, caustics, light = (
        sum(getattr(batch, name) for batch in ours) / count for name in ("all_caustics", "caustics", "light")
    )
    if not whole or any(batch.all_caustics for batch in theirs) or whole < SEEN * light:
        return False
    return bool(caustics < whole / 2 or sum(batch.light for batch in theirs) / count < light - caustics / 2)


@dataclass(frozen=True)
class Race:
    """Candidates against each other. `measure` renders batch number … by settings; batches are kept.

    `allowed`: seconds in all, given those of a pixel in a pass by the settings `own`, from which it starts.
    """

    measure: Callable[[Settings, int], Batch]
    allowed: Callable[[float], float]
    own: str = OWN
    batches: dict[str, list[Batch]] = field(default_factory=dict)  # by the text of the settings

    @property
    def took(self) -> float:
        """Seconds so far."""
        return sum(batch.took for batches in self.batches.values() for batch in batches)

    def best(self, candidates: list[Settings], share: float = 1.0) -> Settings:
        """The first that is not dearer than the cheapest by CLEARLY. `share`: of the seconds, so far."""
        left = {settings_text(candidate): candidate for candidate in candidates}
        for number in range(BATCHES):
            for name, candidate in left.items():
                mine = self.batches.setdefault(name, [])
                if len(mine) <= number:
                    mine.append(self.measure(candidate, number))
            least = self.cheapest(list(left))
            left = {n: c for n, c in left.items() if self.of(n, least).low <= 1}
            predicted = sum(2 * self.batches[name][number].took for name in left)
            seconds = min(batch.seconds for batch in self.batches[self.own])
            if len(left) == 1 or self.took + predicted > share * self.allowed(seconds):
                break
        return next(c for n, c in left.items() if self.of(n, least, CLEARLY).low <= 1)

    def of(self, name: str, other: str, z: float = Z) -> Ratio:
        """The ratio of two candidates' costs."""
        return ratio(self.batches[name], self.batches[other], z)

    def cheapest(self, names: list[str]) -> str:
        """The name with the least cost."""
        return min(names, key=lambda name: self.of(name, names[0]).value)


@dataclass(frozen=True)
class Choice:
    """The settings that a pilot has chosen; its seconds and, over the scene's own, the costs of all candidates."""

    settings: Settings
    figures: dict[str, Any]


def choose(pilot: Pilot) -> Choice:
    """Try STEPS. Settings that are the scene's own are not among those that are chosen.

    Where lamps can be traced that path tracing does not find, they are, whatever it costs.
    ValueError where no light is seen; RuntimeError of Mitsuba.
    """
    start = best = pilot.start
    race = Race(pilot.measure, pilot.allowed, settings_text(start))
    for i, options in enumerate(STEPS):
        merged = [each for option in options if pilot.usable(each := {**best, **option})]
        changed = [{name: value for name, value in each.items() if pilot.own.get(name) != value} for each in merged]
        before = best
        best = race.best(changed if best in changed else [best, *changed], (i + 1) / len(STEPS))
        # Where it cannot be told, lamps are traced: a pilot of path tracing may have met none.
        if options == (CAUSTICS,) and changed:
            unknown = race.of(settings_text(changed[0]), settings_text(before)).high == math.inf
            best = changed[0] if unknown else best
    if 1 <= race.of(settings_text(best), race.own, CLEARLY).high < math.inf:
        best = start
    if not any(batch.light for batches in race.batches.values() for batch in batches):
        text = f"{pilot.parsed.path}: --settings {AUTO}: the pilot sees no light"
        raise ValueError(f"{text}; expected some, or settings by name")
    costs = {name: vars(race.of(name, race.own)) for name in race.batches}
    rounded = {name: {key: float(f"{value:.3g}") for key, value in cost.items()} for name, cost in costs.items()}
    return Choice(best, {"seconds": float(f"{race.took:.3g}"), "of": race.own, "costs": rounded})


def lines_of(figures: dict[str, Any]) -> list[str]:
    """A line for each candidate of `Choice.figures`."""
    return [
        f"cost {cost['value']:g} ({cost['low']:g} to {cost['high']:g}), variance {cost['variance']:g} and time "
        f"{cost['time']:g} of {figures['of']}: {name}"
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
        are limited. ValueError where samples cannot be rendered one by one, and for a sampler that is none of SAMPLERS.
        """
        self.parsed, self.renderer, self.plan, self.seconds = parsed, renderer, plan, seconds
        self.own, self.cuda = own_settings(parsed), "cuda" in str(mi.variant())
        self.clock = time.perf_counter if self.cuda else time.thread_time
        what = f"{parsed.path}: --settings {AUTO}"
        if not renderer.moments:
            expected = "an integrator of samples, a film without a border, and a JIT variant such as llvm_ad_rgb"
            raise ValueError(f"{what}: samples cannot be rendered one by one; expected {expected}")
        if self.own["sampler"] not in SAMPLERS:
            expected = f"{', '.join(SAMPLERS)}, or settings by name"
            raise ValueError(f"{what}: the scene's sampler is {self.own['sampler']}; expected {expected}")
        features = inspect(renderer.scene)
        self.splits = features.splitting
        self.same_image = not (features.absorbing or features.dispersive or features.media)  # `path` ignores these
        node = integrator_node(parsed, {})
        self.swappable = node is not None and not any(
            name.startswith("camera_") or (name, value) == ("deterministic", True) for name, _, value in node[3]
        )
        total = plan(renderer.rounded).total
        self.samples = OPEN_SAMPLES if total is None else SHARE * math.prod(renderer.size) * total
        self.candidates = sum(map(len, STEPS))
        self._samplers: dict[str, Any] = {}
        self._integrators: dict[str, Any] = {}
        self._seconds: dict[str, float] = {}  # of a pixel in a pass
        self._untold = 0.0  # seconds that are in no batch
        self._lamps: Lamps | None = None  # alike for all candidates that trace them
        changed = {name: value for name, value in CAUSTICS.items() if self.own.get(name) != value}
        self.start: Settings = changed if missing_light(renderer.scene) and self.usable(CAUSTICS) else {}

    def usable(self, settings: Settings) -> bool:
        """Whether settings can be rendered here, and give the same image but for noise and light that was missing."""
        if "sampler" in settings:
            try:
                self._sampler(settings)
            except ValueError:  # not with as many samples as a pass shall have
                if settings["sampler"] != self.own["sampler"]:
                    return False
        if not settings.keys() - {"sampler"}:
            return True
        every = self.own | settings
        if not self.swappable or not (every["integrator"] == self.own["integrator"] or self.same_image):
            return False
        traced = every.get("caustics") == "lamp"
        if every["integrator"] == "path":
            return not traced
        return (self.splits or every.get("split_depth", "0") == "0") and (not traced or self._lamps_traceable())

    def _lamps_traceable(self) -> bool:
        scene, integrator = self.renderer.scene, self._integrator(CAUSTICS)
        try:
            return bool(integrator.caustics_of(scene, scene.sensors()[0]) == "lamp")
        except ValueError:
            return False

    def measure(self, settings: Settings, number: int) -> Batch:
        """Batch `number` of a candidate. Its pixels and seeds are those of all candidates.

        The seeds are those of passes counted down from 2³² − 1, which no render comes to.
        """
        name, sampler, integrator = settings_text(settings), self._sampler(settings), self._integrator(settings)
        if name not in self._seconds:
            self._seconds[name] = math.inf
            with quiet():  # what is missing is said of the settings that are chosen
                self._render(integrator, sampler, np.zeros(COPIES, np.uint32), 0, False)  # it compiles
        own_spp, spp = self._sampler({}).sample_count(), sampler.sample_count()
        size = max(LEAST_PIXELS, self.samples / 4 / (COPIES * own_spp * self.candidates))
        size = max(1, int(min(min(size, TIMED / (COPIES * own_spp)) * 2**number, LARGEST / (COPIES * own_spp))))
        places = np.arange(size) + np.random.default_rng([self.renderer.seed, number]).random(size)
        pixels = np.repeat((places * (math.prod(self.renderer.size) / size)).astype(np.uint32), COPIES)
        values, took = self._render(
            integrator, sampler, pixels, seed_of(self.renderer.seed, MASK - number), number == 0
        )
        means = values.reshape(len(values), size, COPIES, spp).mean(-1)
        seconds, caustics, everywhere = took / len(pixels), 0.0, 0.0
        light, variance = float(np.nan_to_num(means).mean()), means.var(-1, ddof=1).mean(0)
        if getattr(integrator, "apart", False) and self._lamps is not None:
            paths, own = integrator.light_paths * spp, pixels[::COPIES]  # paths for each pixel
            variance = variance + self._lamps.variance[own] / (paths * math.prod(self.renderer.size))
            caustics, everywhere = float(self._lamps.light[own].mean()), float(self._lamps.light.mean())
            seconds += paths * self._lamps.seconds
        self._seconds[name] = min(self._seconds[name], seconds)
        took, self._untold = self._seconds[name] * len(pixels) + self._untold, 0.0
        return Batch(variance, light + caustics, seconds, took, caustics, everywhere)

    def allowed(self, own_seconds: float) -> float:
        """Seconds of the pilot, given those of a pixel in a pass with the scene's own settings."""
        threads = 1 if self.cuda else dr.thread_count()
        limit = math.inf if self.seconds is None else SHARE * self.seconds * threads
        passes = self.samples / int(self._sampler({}).sample_count())
        return min(limit, passes * own_seconds)

    def _sampler(self, settings: Settings) -> Any:
        """With as many samples as a pass of the render has, or fewer where the first batches would be too many."""
        name = settings.get("sampler", self.own["sampler"])
        if name not in self._samplers:
            own = name == self.own["sampler"]
            sampler = self.renderer.scene.sensors()[0].sampler().clone() if own else mi.load_dict({"type": name})
            most = max(LEAST_SPP, int(self.samples / (COPIES * LEAST_PIXELS * self.candidates)))
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

    def _render(self, integrator: Any, sampler: Any, pixels: Any, seed: int, first: bool) -> tuple[Doubles, float]:
        """The samples' colours, channels × samples, and the seconds of the kernel: ∞ where they are not measured.

        On processors the time is that of this thread where it renders alone, the `first` batch and few samples: beside
        others it would wait for work, and for other programs.
        """
        values = samples_of_pixels(self.renderer, integrator, sampler, pixels, seed)
        alone = not self.cuda and (first or len(pixels) * sampler.sample_count() <= TIMED)
        dr.sync_thread()
        threads = dr.thread_count()
        if alone:
            dr.set_thread_count(1)
        try:
            before = self.clock()
            dr.eval(values)
            dr.sync_thread()
            took = self.clock() - before if alone or self.cuda else math.inf
        finally:
            if alone:
                dr.set_thread_count(threads)
        if hasattr(integrator, "end_render"):
            if getattr(integrator, "apart", False) and self._lamps is None:
                self._trace_lamps(integrator)
            integrator.end_render()
        return np.array([np.array(value) for value in values], np.float64), took

    def _trace_lamps(self, integrator: Any) -> None:
        """Measure the lamps' part of the image."""
        paths = min(max(int(self.samples / self.candidates), LEAST_LIGHT_PATHS), TIMED)

        def trace(count: int) -> tuple[Any, float]:
            before = self.clock()
            image = integrator.caustic_image(
                self.renderer.scene, self.renderer.scene.sensors()[0], self.renderer.seed, 1, self.renderer.channels,
                squares=True, paths=count,
            )  # fmt: skip
            return image, self.clock() - before

        trace(paths)
        threads = dr.thread_count()
        if not self.cuda:
            dr.set_thread_count(1)
        try:
            # In an empty cache of kernels the first of them compiles once more, which takes ten times as long.
            ((light, variance), first), (_, second) = trace(paths), trace(paths)
        finally:
            if not self.cuda:
                dr.set_thread_count(threads)
        variance, light = (np.nan_to_num(x.mean(-1)).ravel() for x in (variance, light))
        self._lamps = Lamps(variance * paths, light, min(first, second) / paths)
        self._untold += first + second
