"""One pass of a render: the mean of every pixel's samples, and their squares, with the same bits on any number of threads.

Mitsuba adds samples to the film in the order in which threads come by, and the last bits of an image change with it. Here
the samples of the JIT variants are kept, and each pixel is summed by one lane, from its first sample to its last, in
float64. Under a filter w that is wider than a pixel a pixel is Σ w v / Σ w over the samples of its neighbours.
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

from .pass_plan import FEW, seed_of
from .pass_sums import PassSums

COLOURS = ("R", "G", "B", "X", "Y", "Z")


@dataclass(frozen=True)
class PassRenderer:
    """A scene, the seed of its render, and what its first sensor's film holds; of the present variant."""

    scene: Any
    seed: int
    channels: tuple[str, ...]
    moments: bool  # whether samples can be kept: then second moments are known, too

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        width, height = self.scene.sensors()[0].film().crop_size()
        return int(width), int(height)

    @property
    def colours(self) -> int:
        """How many of the channels, from the first on, are colours."""
        return sum(name in COLOURS for name in self.channels)

    def accepted(self, spp: int) -> int:
        """The samples per pixel that the sampler makes of these: it may round up."""
        sampler = self.scene.sensors()[0].sampler().clone()
        with _quiet():
            sampler.set_sample_count(spp)
        return int(sampler.sample_count())

    def render(self, number: int, spp: int) -> PassSums:
        """Pass `number`. The scene's own errors pass; InterruptedError where Mitsuba stopped before the last sample."""
        seed = seed_of(self.seed, number)
        with _quiet():
            if self.moments:
                mean, within = _pixels(self.scene, self.channels, spp, seed, squares=number < FEW - 1)
            else:
                mean, within = _rendered(self.scene, spp, seed), None
        if self.scene.integrator().should_stop():
            raise InterruptedError("the rendering was stopped before its last sample")
        mean = mean.reshape(self.size[1], self.size[0], len(self.channels)).astype(np.float64)
        return PassSums(spp, 1, mean * spp, np.zeros_like(mean), within, colours=self.colours)


def pass_renderer(scene: Any, seed: int) -> PassRenderer:
    """How to render the passes of a loaded scene, with its first sensor."""
    film, integrator = scene.sensors()[0].film(), scene.integrator()
    film.prepare(integrator.aov_names())
    channels = tuple(str(field.name) for field in film.bitmap().struct_())
    return PassRenderer(scene, seed, channels, _keeps_samples(scene))


def _keeps_samples(scene: Any) -> bool:
    """Whether `_pixels` can render the scene: its integrator gives samples and does nothing else, its film takes them."""
    film, integrator = scene.sensors()[0].film(), scene.integrator()
    plain = type(integrator).render is mi.SamplingIntegrator.render or hasattr(integrator, "begin_render")
    special = film.sample_border() or mi.has_flag(film.flags(), mi.FilmFlags.Special)
    return dr.is_jit_v(mi.Float) and isinstance(integrator, mi.SamplingIntegrator) and plain and not special


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without Mitsuba's warning, at every pass, that a sampler rounds up: it is taken into account."""
    logger: Any = mi.logger()
    before = logger.log_level()
    logger.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        logger.set_log_level(before)


def _rendered(scene: Any, spp: int, seed: int) -> np.ndarray:
    """By `mi.render`; by one thread where it would add in the order of threads."""
    box = scene.sensors()[0].film().rfilter().is_box_filter()
    threads = dr.thread_count()
    one = dr.is_jit_v(mi.Float) or not box
    if one:
        dr.set_thread_count(1)
    try:
        return np.array(mi.render(scene, spp=spp, seed=seed))
    finally:
        if one:
            dr.set_thread_count(threads)


# Samples ------------------------------------------------------------------------------------------------------------


def _pixels(scene: Any, channels: tuple[str, ...], spp: int, seed: int, *, squares: bool) -> tuple[Any, Any]:
    """Means of all pixels and, for `squares`, Σ (v − mean)² over their samples, H × W × C."""
    film = scene.sensors()[0].film()
    with dr.suspend_grad():
        values, place = _samples(scene, channels, spp, seed)
        totals, weights = _film_sums(values, place, film, spp)
        means = [mi.Float(total / weights) for total in totals]
        dr.eval(means)
        spreads = _film_sums(values, place, film, spp, means)[0] if squares else []
        within = [spread * dr.square(spp / weights) for spread in spreads]
        dr.eval(within)
    width, height = film.crop_size()
    mean, spread = (np.stack([np.array(v) for v in each], -1) if each else None for each in (means, within))
    shape = (int(height), int(width), len(channels))
    return mean.reshape(shape), None if spread is None else spread.reshape(shape)


def _samples(scene: Any, channels: tuple[str, ...], spp: int, seed: int) -> tuple[list[Any], Any]:
    """The values of all samples by channels, those of a pixel in a row, and their places on the film."""
    from mitsuba.ad.integrators.common import ADIntegrator  # there is none in scalar variants

    sensor, integrator = scene.sensors()[0], scene.integrator()
    if hasattr(integrator, "begin_render"):
        integrator.begin_render(seed)
    sampler, spp = ADIntegrator.prepare(None, sensor, seed, spp, integrator.aov_names())
    ray, weight, place = ADIntegrator.sample_rays(None, scene, sensor, sampler)
    ray.scale_differential(1 / math.sqrt(spp))
    radiance, valid, others = integrator.sample(scene, sampler, ray, sensor.get_medium(), mi.Bool(True))
    values = _colours(channels, mi.unpolarized_spectrum(weight * radiance), ray.wavelengths)
    if "A" in channels[: len(values) + 1]:
        values.append(dr.select(valid, mi.Float(1), mi.Float(0)))
    values += list(others)
    if len(values) != len(channels):
        raise ValueError(f"{len(values)} values in a sample; accepted: {len(channels)}, those of the film")
    place = mi.Point2f(place) - mi.Point2f(sensor.film().crop_offset())
    dr.eval(values, place)
    return values, place


def _colours(channels: tuple[str, ...], radiance: Any, wavelengths: Any) -> list[Any]:
    """What the film makes of a sample's spectrum: R, G, B, or X, Y, Z, or Y."""
    if mi.is_spectral:
        rgb = mi.spectrum_to_srgb(radiance, wavelengths)
    else:
        rgb = mi.Color3f(radiance.x) if mi.is_monochromatic else mi.Color3f(radiance)
    if channels[0] == "R":
        return [rgb.x, rgb.y, rgb.z]
    if channels[0] == "X":
        xyz = mi.srgb_to_xyz(rgb)
        return [xyz.x, xyz.y, xyz.z]
    return [mi.luminance(rgb)]


def _film_sums(values: list[Any], place: Any, film: Any, spp: int, means: list[Any] | None = None) -> tuple[Any, Any]:
    """Of every pixel Σ w v by channels, or with `means` Σ w² (v − mean)², and Σ w, over the samples that reach it.

    One lane sums a pixel, always in the same order.
    """
    width, height = (int(n) for n in film.crop_size())
    rfilter = film.rfilter()
    if rfilter.is_box_filter():
        rfilter, reach = None, 0
    else:
        reach = math.ceil(rfilter.radius() - 0.5)  # pixels
    pixel = dr.arange(mi.Int32, width * height)
    size = mi.Point2i(dr.opaque(mi.Int32, width), dr.opaque(mi.Int32, height))
    y = pixel // size.x
    return _sum_of_lanes(values, place, means, mi.Point2i(pixel - y * size.x, y), size, reach, spp, rfilter)


@dr.syntax
def _sum_of_lanes(values, place, means, pixel, size, reach, spp, rfilter):  # type: ignore[no-untyped-def]  # rewritten
    spp = dr.opaque(mi.UInt32, spp)
    totals = [mi.Float64(0) for _ in values]
    weights = mi.Float64(0)
    j = mi.Int32(-reach)
    while j <= reach:
        i = mi.Int32(-reach)
        while i <= reach:
            x, y = pixel.x + i, pixel.y + j
            inside = (x >= 0) & (x < size.x) & (y >= 0) & (y < size.y)
            first = mi.UInt32(dr.select(inside, x + y * size.x, 0)) * spp
            k = mi.UInt32(0)
            while inside & (k < spp):
                w = mi.Float64(1) if rfilter is None else _weight(rfilter, dr.gather(mi.Point2f, place, first + k), pixel)
                for c in range(len(values)):
                    value = mi.Float64(dr.gather(mi.Float, values[c], first + k))
                    if dr.hint(means is None, mode="scalar"):
                        totals[c] += w * value
                    else:
                        totals[c] += (w * (value - mi.Float64(means[c]))) ** 2
                weights += w
                k += 1
            i += 1
        j += 1
    return totals, weights


def _weight(rfilter: Any, place: Any, pixel: Any) -> Any:
    """The filter's weight in a pixel of a sample at `place`."""
    apart = place - (mi.Point2f(pixel) + 0.5)
    near = (dr.abs(apart.x) <= rfilter.radius()) & (dr.abs(apart.y) <= rfilter.radius())
    return mi.Float64(dr.select(near, rfilter.eval(apart.x) * rfilter.eval(apart.y), 0))
