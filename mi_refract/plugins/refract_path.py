"""The integrator `refract_path`: Mitsuba's `path` without what the scene does not need, and with both lobes of glass.

| parameter | type | meaning and default |
|---|---|---|
| `max_depth`, `rr_depth` | integer | as in `path`: longest path (-1: no limit), start of Russian roulette (5) |
| `hide_emitters` | boolean | as in `path` (false) |
| `samples_per_pass`, `block_size` | integer | as in `path` |
| `timeout` | number | as in `path`: seconds, in scalar variants (-1: no limit) |
| `split_depth` | integer | both lobes are followed at boundaries among so many first surfaces of delta lobes (0) |
| `split_weight` | number | a lobe whose share of the light would be smaller is not followed (0.01) |
| `deterministic` | boolean | no lobe is chosen by chance; lobes with a share below `split_weight` are dropped (false) |
| `caustics` | word | `path`, `lamp` or `auto`: how light through glass onto other surfaces is found (`auto`) |
| `light_paths` | number | light paths for each sample of the camera, where lamps are traced (0.25) |
| `camera_absorption` | number, spectrum | σ of the medium at the camera (0), as `int_absorption` of `refract` |
| `camera_absorption_unit` | number | as `int_absorption_unit` of `refract` |
| `camera_colour` | number, spectrum | as `int_colour` of `refract` |
| `camera_colour_distance` | number | as `int_colour_distance` of `refract` |

No parameter is exposed to `mi.traverse`. Only `refract` and `dielectric` are split, not what is within another BSDF,
and no sample into more than 4096 paths. With `deterministic`, which is for scenes of smooth dielectrics and conductors
alone, both lobes are followed up to 64 boundaries deep, and the default of `split_weight` is 0.001; the channel
`truncated` holds what was dropped: times the largest radiance it bounds the error.

With `caustics` = `path`, light that passes glass or a mirror before it reaches another surface is found by chance, or
not at all where the lamp is a point, a spot or directional. `lamp` traces it from the lamps to all surfaces that the
camera sees directly, along `light_paths` paths for each sample of the camera (`lamp_tracing`). It mostly pays where
lamps are small; with lamps nearly as large as the scene error × time is up to three times that of `path`. It takes
area, point, spot and directional lamps, and perspective, thin-lens and orthographic cameras. In scenes with media of
Mitsuba's, in frozen functions, within another integrator and where a parameter of the scene is differentiated it is an
error. `auto` traces light from points, spots and directional lamps only, and from none where `lamp` would be an error
for any reason but an area lamp: so derivatives are those of the image by path tracing. What is missing is named in a
warning, once a scene (`SceneFeatures.missing`).

Rays of delta lobes start nearer to the surface that they leave than those of `path` (`ray_origins`): glass may be as
thin as 4e-6 of the largest shape with such lobes and 2e-6 of its own largest coordinate together, or 2e-6 of the length
of a ray that enters it, where that is more. A shape of less than the former is named in a warning
(`SceneFeatures.thin`).

In JIT variants a path that splits has random numbers of its own after those of the camera. So have all paths where the
sampler is `multijitter`, `stratified`, `ldsampler` or `orthogonal`: in Mitsuba's stratified samplers the numbers of two
dimensions may be dependent, which biases the image (study `samplers`).

Derivatives are attached: rays move with the index. Edges that move across a pixel, or in the view of a surface that is
not smooth, are not in them. A render that is differentiated does not split.
"""

from __future__ import annotations

import math
import signal
import threading
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refract.numerics import (
    Count,
    Mask,
    MediumPlugin,
    Number,
    Properties,
    Ray,
    Sampler,
    Scene,
    Sensor,
    Spectrum,
    Variant,
)

from . import lamp_tracing
from .absorption import read_absorption
from .index_parameter import warn_once
from .medium_tracking import MediumTracker, ShapeMedia, check_media, extinction
from .path_loop import PathFeatures, PathLoop
from .sampling import STRATIFIED, KeyedMultijitter, SceneSampler, seed_of_pass, seeds_of
from .scene_features import CAST, ONE_SIDED, SceneFeatures, all_shapes, check_shapes, differentiated, inspect

INTEGRATOR = "refract_path"  # its name in Mitsuba
MOST_PATHS = 4096  # that one sample may split into
DEEPEST = 64  # split_depth: memory is set aside in every lane
UNLIMITED = 2**32 - 1
ONE_THREAD = threading.Lock()  # Mitsuba renders the blocks of a scalar render in several threads


def read_count(props: Properties, name: str, default: int, least: int) -> int:
    """An integer parameter, at least `least`. ValueError with its name and what is expected."""
    value = props.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        what = "-1 (no limit) or an integer ≥ 0" if least < 0 else f"an integer ≥ {least}"
        raise ValueError(f"{INTEGRATOR}: {name} = {value!r}; expected {what}")
    return value


def read_flag(props: Properties, name: str) -> bool:
    """A Boolean parameter; False if it is absent. ValueError with its name and what is expected."""
    value = props.get(name, False)
    if not isinstance(value, bool):
        raise ValueError(f"{INTEGRATOR}: {name} = {value!r}; expected true or false")
    return value


def read_caustics(props: Properties) -> tuple[str, float]:
    """`caustics` and `light_paths`. ValueError with what is expected."""
    caustics, paths = props.get("caustics", "auto"), props.get("light_paths", 0.25)
    if caustics not in ("path", "lamp", "auto"):
        raise ValueError(f"{INTEGRATOR}: caustics = {caustics!r}; expected path, lamp or auto")
    if isinstance(paths, bool) or not isinstance(paths, (int, float)) or not 0 < paths <= 64:
        raise ValueError(f"{INTEGRATOR}: light_paths = {paths!r}; expected a number above 0 and up to 64")
    return str(caustics), float(paths)


def read_split(props: Properties, deterministic: bool) -> tuple[int, float]:
    """`split_depth` and `split_weight`. ValueError if one sample could split into more than MOST_PATHS paths."""
    depth = read_count(props, "split_depth", DEEPEST if deterministic else 0, 0)
    weight = props.get("split_weight", 1e-3 if deterministic else 1e-2)
    if isinstance(weight, bool) or not isinstance(weight, (int, float)) or not 0 <= weight <= 1:
        raise ValueError(f"{INTEGRATOR}: split_weight = {weight!r}; expected a number from 0 to 1")
    # Every path has a share above the weight, and all of them together have 1.
    paths = min(2.0**depth, 1 / weight if weight else math.inf)
    if depth > DEEPEST or paths > MOST_PATHS:
        raise ValueError(
            f"{INTEGRATOR}: split_depth = {depth}, split_weight = {weight}: one sample could split into {paths:.3g} "
            f"paths; expected 2^split_depth or 1/split_weight up to {MOST_PATHS}, and split_depth up to {DEEPEST}"
        )
    return depth, float(weight)


def restore_interrupts() -> None:
    """Install Python's handler of SIGINT again, in the main thread.

    While Mitsuba renders, SIGINT has a handler of Mitsuba's, which remembers one former handler. A render within a
    render, as of every integrator in Python with a `render` of its own, would remember Mitsuba's and restore that one.
    """
    handler = signal.getsignal(signal.SIGINT)  # None: not one of Python's
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, handler)


def integrator_class(v: Variant) -> type:
    """The class of the integrator for one variant, given its module."""
    vectorised = dr.is_jit_v(v.Float)

    def to_camera(sensor: Sensor) -> Any:
        """The transform from world to camera, where rays start in the plane z = 0; None if they start at the sensor."""
        return sensor.world_transform().inverse() if isinstance(sensor, v.ProjectiveCamera) else None

    class RefractPath(v.SamplingIntegrator):  # type: ignore[misc]
        """See the module docstring."""

        def __init__(self, props: Properties) -> None:
            super().__init__(props)
            depth = read_count(props, "max_depth", -1, -1)
            self.max_depth = depth if depth >= 0 else UNLIMITED
            self.rr_depth = read_count(props, "rr_depth", 5, 1)
            self.deterministic = read_flag(props, "deterministic")
            self.split_depth, self.split_weight = read_split(props, self.deterministic)
            self.caustics, self.light_paths = read_caustics(props)
            self.camera = read_absorption(INTEGRATOR, props, "camera")
            self.samples_per_pass = read_count(props, "samples_per_pass", UNLIMITED, 1)
            # Not the scene, which holds its integrator: a circle cannot be frozen.
            self.needs: SceneFeatures | None = None  # of the scene rendered last
            self.rendering = False  # between `begin_render` and `end_render`
            self.sensor: Sensor | None = None  # of this render
            self.seed: Any = None  # of this render, if known
            self.near: Any = None  # its `to_camera`
            self.apart = False  # lamps are traced in the scene rendered last
            self.unconnected = ""  # why that sensor's lamps cannot be traced
            self.untraced = ""  # why no lamps were traced in the scene rendered last, though `caustics` = `auto`
            self.loops: list[PathLoop] = []  # of this render: one a pass; in scalar variants one in all

        def begin_render(self, sensor: Sensor, seed: Any = None) -> None:
            """Call this before `sample` if `render` is not called; otherwise each sample inspects the scene again.

            `seed`: of the render; None: random numbers are seeded by the sampler, lane by lane.
            """
            self.loops, self.rendering, self.seed = [], True, seed
            self.sensor, self.near = sensor, to_camera(sensor)
            self.unconnected = lamp_tracing.refused_sensor(sensor)

        def end_render(self) -> None:
            """Call this after the samples were evaluated. ValueError if absorption was inconsistent."""
            loops = self.loops
            self.forget()
            for loop in loops:
                loop.refuse()

        def forget(self) -> None:
            """End a render."""
            self.loops, self.rendering, self.sensor, self.seed = [], False, None, None

        def render(
            self,
            scene: Scene,
            sensor: Sensor | int = 0,
            seed: Any = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Any:
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            restore_interrupts()
            self.begin_render(sensor, seed)
            try:
                image = super().render(scene, sensor, seed, spp, develop, evaluate)
                if any(loop.features.lamps_traced for loop in self.loops):
                    image = self.add_caustics(scene, sensor, seed, spp, develop)
                self.end_render()
            finally:
                self.forget()
            return image

        def add_caustics(self, scene: Scene, sensor: Sensor, seed: Any, spp: int, develop: bool) -> Any:
            """Add the lamps' part to the film, which holds path tracing's."""
            film, sampler = sensor.film(), sensor.sampler().clone()
            if spp:
                sampler.set_sample_count(spp)
            number: Any = dr.slice(seed)
            caustic = self.caustic_image(scene, sensor, int(number), int(sampler.sample_count()), ("R", "G", "B"))
            # A film holds sums of colours, and after them and alpha the sum of weights by which it divides them.
            block, sums = film.create_block(), film.develop(True)
            weight = 4 if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else 3
            values = block.tensor().numpy()
            values[..., :3] = caustic[0] * sums.numpy()[..., weight : weight + 1]
            block.tensor()[:] = type(sums)(values)
            film.put_block(block)
            return film.develop() if develop else v.TensorXf()

        def caustic_image(
            self,
            scene: Scene,
            sensor: Sensor,
            seed: int,
            spp: int,
            channels: tuple[str, ...],
            *,
            squares: bool = False,
            paths: int = 0,
        ) -> Any:
            """The result of `lamp_tracing.lamp_image` for a render that has begun; None if no lamps are traced.

            `paths`: number of light paths; by default it follows from `spp`.
            """
            loop = next((loop for loop in self.loops if loop.features.lamps_traced), None)
            if loop is None:
                return None
            tracer = lamp_tracing.LampTracer(loop, sensor, lambda ray: self.camera_medium(scene, ray, None))
            paths = paths or max(1, round(self.light_paths * spp * tracer.camera.width * tracer.camera.height))
            if type(own := sensor.sampler()) is v.Sampler:  # which may have a seed of its own
                import numpy as np

                probe = own.clone()
                probe.seed(seed, 1)
                number: Any = dr.slice(probe.next_1d())
                word = int(float(number) * 2**24)
                seed = int(np.random.SeedSequence((seed, word)).generate_state(1)[0])
            return lamp_tracing.lamp_image(tracer, seed, paths, channels, squares=squares)

        def aov_names(self) -> list[str]:
            return ["truncated"] if self.deterministic else []

        def sample(
            self, scene: Scene, sampler: Sampler, ray: Ray, medium: MediumPlugin = None, active: Mask = True
        ) -> tuple[Spectrum, Mask, list[Any]]:
            if self.max_depth == 0:
                return v.Spectrum(0), v.Bool(False), [v.Float(0)] * len(self.aov_names())
            loop = self.path_loop(scene, sampler)
            camera = self.camera_medium(scene, ray, medium) if loop.features.absorption else ()
            end = loop.run(v.Ray3f(ray), sampler, v.Bool(active), *camera)
            if loop.features.absorption and not self.rendering:  # another integrator evaluates the image
                dr.eval(end.result)
                loop.refuse()
            return dr.select(end.valid_ray, end.result, 0), end.valid_ray, [end.truncated][: len(self.aov_names())]

        def path_loop(self, scene: Scene, sampler: Sampler) -> PathLoop:
            """The loop of a pass of a render. In scalar variants all samples of a render share one."""
            if vectorised:
                return self.new_loop(scene, sampler)
            with ONE_THREAD:
                loop = next((loop for loop in self.loops if loop.scene is scene), None)
                return loop or self.new_loop(scene, sampler)

        def new_loop(self, scene: Scene, sampler: Sampler) -> PathLoop:
            """A loop for the scene as it is now."""
            needs = self.scene_features(scene)
            features = self.path_features(needs)
            count = min(self.samples_per_pass, sampler.sample_count()) if vectorised else 1
            numbers: Any = SceneSampler()
            if vectorised and (features.split_depth or sampler.class_name() in STRATIFIED):
                numbers = KeyedMultijitter(v, self.seeds(sampler), sampler.wavefront_size(), count)
            media: ShapeMedia | MediumTracker | None = None
            if features.absorption:
                media = ShapeMedia(v) if needs.shape_media else MediumTracker(v, scene, features.delta_extent)
            loop = PathLoop(v, scene, features, numbers, media)
            if self.rendering:
                self.loops.append(loop)
            return loop

        def seeds(self, sampler: Sampler) -> Count:
            """The seed of the next pass, or one for each lane where the seed of the render is not known."""
            own = self.sensor.sampler() if self.sensor else None
            if self.seed is None or type(own) is not v.Sampler:  # a sampler in Python may have no `clone`
                return seeds_of(v, sampler)
            return seed_of_pass(v, own, self.seed, len(self.loops))

        def camera_medium(self, scene: Scene, ray: Ray, medium: MediumPlugin) -> tuple[Spectrum, Number]:
            """σ at the camera, and the way from there to the origin of the ray."""
            sigma, way = 0, v.Float(0)
            if self.camera:
                si = dr.zeros(v.SurfaceInteraction3f)
                si.wavelengths = ray.wavelengths
                sigma = self.camera.eval(si, v.Bool(True))
            elif medium is not None:
                sigma = extinction(v, medium, ray.wavelengths, v.Bool(True))
            if medium is not None or self.camera:  # rays start on the near plane
                sensors = scene.sensors()
                if not self.rendering and len(sensors) != 1:  # another integrator does not say which one it renders
                    raise ValueError(
                        f"{INTEGRATOR}: the camera is in an absorbing medium; expected one sensor in the scene"
                    )
                if (self.sensor or sensors[0]).class_name() == "BatchSensor":  # whose near planes are not known
                    raise ValueError(
                        f"{INTEGRATOR}: the cameras of a batch are in an absorbing medium; expected one camera a render"
                    )
                if (place := self.near if self.rendering else to_camera(sensors[0])) is not None:
                    way = (place @ ray.o).z / (place @ ray.d).z
            return sigma, way

        def caustics_of(self, scene: Scene, sensor: Sensor) -> str:
            """What `caustics` means in a render: "path", "lamp" or, if only some lamps are traced, "auto".

            ValueError if the scene does not allow `caustics` = `lamp`.
            """
            self.begin_render(sensor)
            try:
                if not self.traces_lamps(scene, inspect(scene, sensor)):
                    return "path"
                return self.caustics if any(map(lamp_tracing.has_area, scene.emitters())) else "lamp"
            finally:
                self.forget()

        def traces_lamps(self, scene: Scene, needs: SceneFeatures) -> bool:
            """Whether lamps are traced in this render. ValueError if `caustics` = `lamp` and they cannot be."""
            self.untraced = ""
            if self.caustics == "path" or not (needs.lamps and needs.smooth and (needs.delta or needs.null)):
                return False
            if self.caustics == "auto" and CAST not in needs.missing("path", self.max_depth):
                return False
            symbolic, frozen = not vectorised or dr.flag(dr.JitFlag.SymbolicLoops), dr.flag(dr.JitFlag.FreezingScope)
            reasons = {
                "another integrator calls it": not self.rendering,
                "the render is differentiated": not symbolic
                or (not frozen and any(map(differentiated, filter(None, (scene, self.sensor))))),
                "a frozen function": frozen,
                "the scene has media": needs.media,
                f"a {needs.delta_perturbed} has delta lobes": bool(needs.delta_perturbed),
                self.unconnected: bool(self.unconnected),
                (lamps := "" if frozen else lamp_tracing.refused_lamps(v, scene, self.caustics == "lamp")): bool(lamps),
            }
            reason = next((text for text, found in reasons.items() if found), "")
            if reason and self.caustics == "lamp":
                raise ValueError(f"{INTEGRATOR}: caustics = lamp: {reason}; expected caustics = path")
            self.untraced = reason
            return not reason

        def path_features(self, needs: SceneFeatures) -> PathFeatures:
            """The features that are traced for a scene. ValueError if `deterministic` is set and impossible."""
            # Local memory has no derivatives, and the evaluated loops that derivatives need have no local memory.
            symbolic = not vectorised or dr.flag(dr.JitFlag.SymbolicLoops)
            if self.deterministic and needs.chance:
                frozen = " in a frozen function, where no diffuse counts as black"
                is_diffuse = needs.chance.startswith("SmoothDiffuse at ")
                chance = needs.chance + frozen * (is_diffuse and dr.flag(dr.JitFlag.FreezingScope))
                expected = "expected only smooth dielectrics and conductors"
                raise ValueError(f"{INTEGRATOR}: deterministic = true: {chance}; {expected}")
            if self.deterministic and not symbolic:
                raise ValueError(f"{INTEGRATOR}: deterministic = true; such a render cannot be differentiated")
            if not symbolic and needs.refracting and needs.smooth and needs.area:
                warn_once(
                    f"{INTEGRATOR}: derivatives leave out edges of area lights that move, seen through a boundary from "
                    "a surface that is not smooth"
                )
            return PathFeatures(
                self.max_depth,
                self.rr_depth,
                self.hide_emitters,
                self.split_depth if symbolic else 0,
                self.split_weight,
                self.deterministic,
                emitter_sampling=needs.smooth and (needs.lamps if needs.plain_environment else needs.sampleable),
                lamps_only=needs.plain_environment,
                lamps_at_infinity=needs.lamps_at_infinity,
                area=needs.area,
                environment=needs.environment,
                first_number=needs.both_numbers or not (needs.smooth or self.deterministic),
                second_number=needs.smooth,
                all_of_hit=needs.smooth or needs.textured,
                dispersion=needs.dispersive,
                absorption=needs.absorbing or needs.media or self.camera is not None,
                null=needs.null,
                lamps_traced=self.apart,
                caustics_apart=self.apart and self.caustics == "lamp",
                delta_extent=needs.delta_extent,
            )

        def scene_features(self, scene: Scene) -> SceneFeatures:
            """The features of the scene as it is now: an edit of the scene can change them."""
            before, self.needs = (self.needs, self.apart), (needs := inspect(scene, self.sensor))
            self.apart = self.traces_lamps(scene, needs)
            missing = needs.missing("lamp" if self.apart else "path", self.max_depth)
            untraced = f"; its lamps are not traced: {self.untraced}" if self.untraced else ""
            warnings = [f"missing {path_class}: {text}{untraced}" for path_class, text in missing.items()]
            if needs.thin:
                warnings.append(needs.thin)
            warnings = warnings if (needs, self.apart) != before else []
            if needs.inexact and not (before[0] and before[0].inexact):  # depends on the camera, so once for all places
                warnings.append(needs.inexact)
            for text in warnings:
                mi.Log(mi.LogLevel.Warn, f"{INTEGRATOR}: {text}")  # type: ignore[operator]
            attached = vectorised and not dr.flag(dr.JitFlag.SymbolicLoops)
            instances = [shape for shape in scene.shapes() if attached and shape.class_name() == "Instance"]
            if any(dr.grad_enabled(mi.traverse(instance)["to_world"]) for instance in instances):
                warn_once(
                    f"{INTEGRATOR}: Mitsuba does not differentiate to_world of an instance; expected that of the "
                    "shapes in its group"
                )
            if needs.textured or ONE_SIDED & {shape.class_name() for shape in all_shapes(scene)}:
                check_shapes(scene)
            if needs.absorbing or needs.media:
                check_media(v, scene, self.sensor)
            mi.Log(mi.LogLevel.Info, f"{INTEGRATOR}: left out: {self.left_out()}")  # type: ignore[operator]
            return needs

        def left_out(self) -> str:
            """What was left out of the scene rendered last, each feature with the reason."""
            if self.needs is None:
                return "no scene seen yet"
            return "; ".join(f"{feature} ({reason})" for feature, reason in self.needs.left_out.items()) or "nothing"

        def to_string(self) -> str:
            depth = -1 if self.max_depth == UNLIMITED else self.max_depth
            names = ["rr_depth", "hide_emitters", "split_depth", "split_weight", "deterministic"]
            names += ["caustics", "light_paths"]
            lines = [f"max_depth = {depth}", *(f"{name} = {getattr(self, name)}" for name in names)]
            return "RefractPath[\n" + "".join(f"  {x},\n" for x in [*lines, f"left out = {self.left_out()}"]) + "]"

    return RefractPath


def register(variant: Variant) -> None:
    """Register `refract_path` in one variant, given its module. Registering again is harmless."""
    variant.register_integrator(INTEGRATOR, integrator_class(variant))
