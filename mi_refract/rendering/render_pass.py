"""One pass of a render: sums of the samples of every pixel, with bits that do not depend on the number of threads.

Mitsuba adds samples to the film in the order in which threads finish, and the last bits of an image depend on that
order. Here the samples of JIT variants are kept, and one lane sums each pixel, from its first sample to its last, in
float64. With a filter w that is wider than a pixel, a pixel is Σ w v / Σ w over its own samples and those of its
neighbours. The two sums are stored separately, because the mean of such quotients over passes is biased: by 2 % for a
pixel beside a bright edge in passes of 4 samples.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refract.io.image_file import Metadata
from mi_refract.numerics import Ray, Sampler, Scene, Spectrum
from mi_refract.plugins.film import STEP, expected_weights, film_colours, filter_weights

from .pass_plan import BLOCK, FEW, scalar_seed_of, seed_of
from .pass_sums import Doubles, PassSums
from .sample_sums import Film, image_sums

# A single thread is the caller's own, which keeps denormals. Other threads flush them to 0, so bits would differ.
LEAST_THREADS = 2


@dataclass(frozen=True)
class PassRenderer:
    """A scene in the present variant, the seed of its render, and the channels of its first sensor's film."""

    scene: Scene
    seed: int
    channels: tuple[str, ...]
    moments: bool  # whether samples can be kept, so that their second moments are known
    expected: Doubles | None = None  # Σ w of one sample in each pixel, H × W × 1; None for a box filter

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        width, height = self.scene.sensors()[0].film().crop_size()
        return int(width), int(height)

    @property
    def filter_header(self) -> Metadata:
        """The file's entries on the film's filter w: its radius in pixels, and its area (∫∫w)²/∫∫w².

        The variance of a tile's mean is that of independent pixels times the area. Neighbours share samples if the
        radius is above 0.5 and the area above 1.
        """
        rfilter = self.scene.sensors()[0].film().rfilter()
        if rfilter.is_box_filter():
            return {"mi_refract:filter_radius": 0.5, "mi_refract:filter_area": 1.0}
        weights = filter_weights(rfilter)
        area = float((np.square(weights.sum()) / np.square(weights).sum() * STEP) ** 2)  # w(x, y) = w(x) w(y)
        return {"mi_refract:filter_radius": float(rfilter.radius()), "mi_refract:filter_area": area}

    @property
    def colours(self) -> int:
        """Number of channels, from the first on, that are colours: all but the opacity and the integrator's AOVs."""
        of_film = self.channels[: len(self.channels) - len(self.scene.integrator().aov_names())]
        return sum(name != "A" for name in of_film)

    @property
    def jitter(self) -> bool:
        """Whether the sampler's points are random in their strata. Otherwise those of all passes are on one grid."""
        sampler = self.scene.sensors()[0].sampler()  # one written in Python may lack `to_string`
        return type(sampler) is not mi.Sampler or "jitter = 0" not in str(sampler)

    def rounded(self, spp: int) -> int:
        """Return `spp` as the scene's sampler rounds it up."""
        return set_spp(self.scene.sensors()[0].sampler().clone(), spp)

    def render(self, number: int, spp: int) -> PassSums:
        """Render pass `number` and return its sums. InterruptedError if Mitsuba stopped before the last sample."""
        within, film = None, self.scene.sensors()[0].film()
        with quiet(), forgetting(self.scene.integrator()):
            if self.moments:
                if dr.thread_count() < LEAST_THREADS:
                    dr.set_thread_count(LEAST_THREADS)
                pixels = Film(*self.size, spp, None if film.rfilter().is_box_filter() else film.rfilter())
                with dr.suspend_grad():
                    samples = _samples(self.scene, self.channels, spp, seed_of(self.seed, number))
                    # For more passes their spread is the better estimate of the variance.
                    total, weights, within = image_sums(*samples, pixels, squares=number < FEW - 1)
                integrator = self.scene.integrator()
                if hasattr(integrator, "end_render"):
                    self._add_caustics(total, weights, within, number, spp)
                    integrator.end_render()
            elif dr.is_jit_v(mi.Float):
                total, weights = _rendered(self.scene, spp, seed_of(self.seed, number))
            else:
                border = 2 * film.rfilter().border_size() if film.sample_border() else 0
                size = (length + border for length in self.size)
                total, weights = _rendered(self.scene, spp, scalar_seed_of(self.seed, number, *size))
        if self.expected is None or weights is None:
            return PassSums(spp, 1, total, np.zeros_like(total), within, colours=self.colours)
        total, weights = total / self.expected, weights / self.expected
        within = None if within is None else within / np.square(self.expected)
        return PassSums(spp, 1, total, np.zeros_like(total), within, weights, colours=self.colours)

    def _add_caustics(
        self, total: Doubles, weights: Doubles | None, within: Doubles | None, number: int, spp: int
    ) -> None:
        """Add the lamps' part of the image to the sums of a pass, if the integrator renders it separately."""
        sensor, seed = self.scene.sensors()[0], seed_of(self.seed, number)
        caustic_image = self.scene.integrator().caustic_image
        caustics = caustic_image(self.scene, sensor, seed, spp, self.channels, squares=within is not None)
        if caustics is None:
            return
        image, variance = caustics
        colours = image.shape[-1]
        total[..., :colours] += image * (spp if weights is None else weights)
        if within is not None:  # the variance of the mean is within / spp (spp − 1), with w in units of `expected`
            squared_weight = 1 if self.expected is None else np.square(self.expected)
            within[..., :colours] += spp * (spp - 1) * variance * squared_weight


def set_spp(sampler: Sampler, spp: int) -> int:
    """Set the samples per pixel of a sampler, and return their number, which the sampler may have rounded up."""
    with quiet():
        sampler.set_sample_count(spp)
    return int(sampler.sample_count())


def pass_renderer(scene: Scene, seed: int) -> PassRenderer:
    """Return the renderer of a loaded scene's passes, with its first sensor."""
    film, integrator = scene.sensors()[0].film(), scene.integrator()
    film.prepare(integrator.aov_names())
    channels = tuple(str(field.name) for field in film.bitmap().struct_())
    # Samples can be kept if the integrator does nothing but return samples, and the film nothing but store them.
    plain = type(integrator).render is mi.SamplingIntegrator.render or hasattr(integrator, "begin_render")
    special = film.sample_border() or mi.has_flag(film.flags(), mi.FilmFlags.Special)
    keeps = dr.is_jit_v(mi.Float) and isinstance(integrator, mi.SamplingIntegrator) and plain and not special
    return PassRenderer(scene, seed, channels, keeps, expected=expected_weights(film))


@contextlib.contextmanager
def forgetting(integrator: Any) -> Iterator[None]:
    """Within this context an integrator may begin a render; afterwards, also after an error, it is in none."""
    try:
        yield
    finally:
        if hasattr(integrator, "forget"):
            integrator.forget()


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Suppress the warnings of Mitsuba and of our plugins, which would be repeated at every pass.

    Mitsuba's is that a sampler rounds up, for which plans account; `resume` collects ours (`defects`, `missing_light`).
    """
    logger: Any = mi.logger()  # type: ignore[operator]
    before = logger.log_level()
    logger.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        logger.set_log_level(before)


def _rendered(scene: Scene, spp: int, seed: int) -> tuple[Doubles, Doubles | None]:
    """Return Σ w v and Σ w by `mi.render`, which runs in one thread if the order of threads would change sums.

    In scalar variants it has fewer threads than there are blocks, or Mitsuba makes smaller blocks, which have other
    random numbers.
    """
    film = scene.sensors()[0].film()
    box = film.rfilter().is_box_filter()
    threads, blocks = dr.thread_count(), math.prod(-(-int(length) // BLOCK) for length in film.crop_size())
    most = 1 if dr.is_jit_v(mi.Float) or not box else max(1, blocks - 1)
    if most < threads:
        _set_threads(most)
    try:
        mi.render(scene, spp=spp, seed=seed)
        if scene.integrator().should_stop():  # by its `timeout`, or by a signal that Mitsuba handled
            raise InterruptedError("the rendering was stopped before its last sample")
    finally:
        if most < threads:
            _set_threads(threads)
    mean = np.array(film.bitmap(), np.float64)  # the return value of `aov` has fewer channels
    mean = mean.reshape(*mean.shape[:2], -1)
    raw = film.bitmap(raw=True)
    names = [field.name for field in raw.struct_()]
    if box or "W" not in names or not isinstance(scene.integrator(), mi.SamplingIntegrator):
        return mean * spp, None
    weights = np.array(raw, np.float64)[..., names.index("W"), None]
    return mean * weights, weights


def _set_threads(count: int) -> None:
    """Set the number of threads after all kernels: a kernel runs in the threads that exist when it starts."""
    if dr.is_jit_v(mi.Float):
        dr.sync_thread()
    dr.set_thread_count(count)


# Samples ------------------------------------------------------------------------------------------------------------


def _samples(scene: Scene, channels: tuple[str, ...], spp: int, seed: int) -> tuple[list[Any], Any]:
    """Return the values of all samples by channel, pixel after pixel, and their positions on the film."""
    from mitsuba.ad.integrators.common import ADIntegrator  # does not exist in scalar variants

    sensor, integrator = scene.sensors()[0], scene.integrator()
    if hasattr(integrator, "begin_render"):
        integrator.begin_render(sensor, seed)
    sampler, spp = ADIntegrator.prepare(None, sensor, seed, spp, integrator.aov_names())
    ray, weight, position = ADIntegrator.sample_rays(None, scene, sensor, sampler)
    ray.scale_differential(1 / math.sqrt(spp))
    values = _channels(scene, integrator, channels, sampler, ray, weight)
    return values, mi.Point2f(position) - mi.Point2f(sensor.film().crop_offset())


def _channels(
    scene: Scene, integrator: Any, channels: tuple[str, ...], sampler: Sampler, ray: Ray, weight: Spectrum
) -> list[Any]:
    """Return the values of samples by channel; `ray`, `weight`: as sampled by the sensor."""
    medium = scene.sensors()[0].get_medium()
    radiance, valid, aovs = integrator.sample(scene, sampler, ray, medium, mi.Bool(True))
    values = film_colours(mi, weight * radiance, ray.wavelengths, channels)
    if "A" in channels[: len(values) + 1]:
        values.append(dr.select(valid, mi.Float(1), mi.Float(0)))
    values += list(aovs)
    if len(values) != len(channels):
        raise ValueError(f"{len(values)} values in a sample; expected {len(channels)}, those of the film")
    return values


def samples_of_pixels(
    renderer: PassRenderer, integrator: Any, sampler: Sampler, pixels: np.ndarray, seed: int
) -> list[Any]:
    """Return the colours of the samples of some pixels by channel, pixel after pixel, not yet evaluated.

    `pixels`: numbers of pixels, row by row; a repeated number has independent samples. `sampler`: determines the
    samples per pixel, which are stratified as in a pass.
    """
    scene, sensor = renderer.scene, renderer.scene.sensors()[0]
    spp, (width, _) = sampler.sample_count(), renderer.size
    if hasattr(integrator, "begin_render"):
        integrator.begin_render(sensor, seed)
    sampler.set_samples_per_wavefront(spp)
    sampler.seed(seed, len(pixels) * spp)
    number = dr.arange(mi.UInt32, len(pixels) * spp) // dr.opaque(mi.UInt32, spp)
    number = dr.gather(mi.UInt32, mi.UInt32(pixels), number)
    y = number // dr.opaque(mi.UInt32, width)
    position = mi.Vector2f(mi.Float(number - y * width), mi.Float(y)) + sampler.next_2d()
    # Random numbers in the order of `ADIntegrator.sample_rays`.
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Vector2f(0)
    time = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    wavelength = sampler.next_1d() if mi.is_spectral else 0
    position /= mi.ScalarVector2f(renderer.size)
    ray, weight = sensor.sample_ray_differential(time, wavelength, position, aperture)
    ray.scale_differential(1 / math.sqrt(spp))
    return _channels(scene, integrator, renderer.channels, sampler, ray, weight)[: renderer.colours]
