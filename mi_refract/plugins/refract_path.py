"""The integrator `refract_path`: Mitsuba's `path` without what the scene does not need, and with both lobes of glass.

Parameters: `max_depth`, `rr_depth`, `hide_emitters` as in `path`. `split_depth` (0): at so many boundaries of a path,
counted from the camera, both lobes of glass are followed, each with its power, instead of one by chance.
`split_weight` (0.01): but no lobe whose share of the light is smaller. `deterministic` (False): no lobe is chosen by
chance, and lobes with a smaller share are dropped; the channel `truncated` holds what was dropped, and times the
largest radiance it is a bound of the error.

Derivatives are attached: rays move with the index. Edges that move across a pixel, or in the view of a surface that is
not smooth, are not in them. A render that is differentiated does not split.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from .absorption import read_absorption
from .integrator_context import warn_once
from .keyed_sampler import KeyedMultijitter, Sampled
from .medium_tracking import Crossings, MediumTracker, ShapeMedia, absorbs_only, check_media, check_wrappers, extinction
from .path_loop import PathFeatures, Trace
from .scene_features import SceneFeatures, inspect

INTEGRATOR = "refract_path"
MOST_PATHS = 4096  # that one sample may split into
DEEPEST = 64  # split_depth: memory is set aside in every lane
UNLIMITED = 2**32 - 1


def read_count(props: Any, name: str, default: int, least: int) -> int:
    """An integer parameter, at least `least`. ValueError with its name and what is accepted."""
    value = props.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        what = "-1 (no limit) or an integer ≥ 0" if least < 0 else f"an integer ≥ {least}"
        raise ValueError(f"{INTEGRATOR}: {name} = {value!r}; expected {what}")
    return value


def read_flag(props: Any, name: str) -> bool:
    """A Boolean parameter, False where it is not given. ValueError with its name and what is accepted."""
    value = props.get(name, False)
    if not isinstance(value, bool):
        raise ValueError(f"{INTEGRATOR}: {name} = {value!r}; expected true or false")
    return value


def read_split(props: Any, deterministic: bool) -> tuple[int, float]:
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


def _camera(v: Any, sensor: Any) -> Any:
    """From the world to the camera, in whose space rays leave the plane z = 0; None where they start at the sensor."""
    return sensor.world_transform().inverse() if isinstance(sensor, v.ProjectiveCamera) else None


def integrator_class(v: Any) -> type:
    """The class of the integrator for one variant, given its module."""
    vectorised = dr.is_jit_v(v.Float)

    class RefractPath(v.SamplingIntegrator):
        """See the module docstring."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            depth = read_count(props, "max_depth", -1, -1)
            self.max_depth = depth if depth >= 0 else UNLIMITED
            self.rr_depth = read_count(props, "rr_depth", 5, 1)
            self.deterministic = read_flag(props, "deterministic")
            self.split_depth, self.split_weight = read_split(props, self.deterministic)
            self.camera = read_absorption(INTEGRATOR, props, "camera")
            self.samples_per_pass = props.get("samples_per_pass", UNLIMITED)
            # Not the scene, which holds its integrator: a circle cannot be frozen.
            self.needs: SceneFeatures | None = None  # of the scene rendered last
            self.rendering = False  # between `begin_render` and `end_render`
            self.near: Any = None  # the near plane of the sensor of this render, by its transformation
            self.crossings: list[Crossings] = []  # one a pass; in scalar variants one in all

        def begin_render(self, sensor: Any) -> None:
            """To be called before `sample` where no `render` is; else each sample looks the scene up anew."""
            self.needs, self.rendering, self.crossings = None, True, []
            self.near = _camera(v, sensor)

        def end_render(self) -> None:
            """To be called after what `sample` gave was evaluated. ValueError where absorption was contradictory."""
            self.rendering = False
            self._refuse()

        def _refuse(self) -> None:
            for crossings in self.crossings:
                crossings.refuse()

        def render(self, scene: Any, sensor: Any = 0, *more: Any, **named: Any) -> Any:
            self.begin_render(scene.sensors()[sensor] if isinstance(sensor, int) else sensor)
            try:
                image = super().render(scene, sensor, *more, **named)
            finally:
                self.rendering = False
            self.end_render()
            return image

        def aov_names(self) -> list[str]:
            return ["truncated"] if self.deterministic else []

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[Any]]:
            if self.max_depth == 0:
                return v.Spectrum(0), v.Bool(False), [v.Float(0)] * len(self.aov_names())
            plan = self.plan(scene)
            count = min(self.samples_per_pass, sampler.sample_count()) if vectorised else 1
            numbers = KeyedMultijitter(v, sampler, count) if vectorised and plan.split_depth else Sampled()
            media = self._media(scene, ray, medium) if plan.absorption else None
            end = Trace(v, scene, plan, numbers, media).run(v.Ray3f(ray), sampler, v.Bool(active))
            if plan.absorption and not self.rendering:  # another integrator evaluates the image, and asks no more
                dr.eval(end.result)
                self._refuse()
                self.crossings = []
            return dr.select(end.valid, end.result, 0), end.valid, [end.truncated] if self.deterministic else []

        def _media(self, scene: Any, ray: Any, medium: Any) -> MediumTracker | ShapeMedia:
            sigma = self._sigma(ray, medium)
            way = self._before(scene, ray) if medium is not None or self.camera else v.Float(0)
            if self._needs(scene).shape_media:
                return ShapeMedia(v, sigma, way)
            return MediumTracker(v, scene, sigma, way, self._crossings(scene))

        def _before(self, scene: Any, ray: Any) -> Any:
            """The way from the camera to the origin of the ray, on the near plane.

            Another integrator does not say which sensor it renders: the scene must have one.
            """
            sensors = scene.sensors()
            if not self.rendering and len(sensors) != 1:
                raise ValueError(f"{INTEGRATOR}: a camera in an absorbing medium; expected one sensor in the scene")
            to_camera = self.near if self.rendering else _camera(v, sensors[0])
            if to_camera is None:
                return v.Float(0)
            return (to_camera @ ray.o).z / (to_camera @ ray.d).z

        def _crossings(self, scene: Any) -> Crossings:
            if vectorised or not self.crossings:
                self.crossings.append(Crossings(v, scene))
            return self.crossings[-1]

        def _sigma(self, ray: Any, medium: Any) -> Any:
            """Absorption where the camera is: as told, or of the sensor's medium, or none."""
            if self.camera:
                si = dr.zeros(v.SurfaceInteraction3f)
                si.wavelengths = ray.wavelengths
                return self.camera.eval(si, v.Bool(True))
            if medium is None:
                return 0
            return extinction(v, medium, ray.wavelengths, v.Bool(True))

        def plan(self, scene: Any) -> PathFeatures:
            """The features that are traced for a scene. ValueError where `deterministic` is set and impossible."""
            needs = self._needs(scene)
            # Local memory has no derivatives, and the evaluated loops that derivatives need have no local memory.
            symbolic = not vectorised or dr.flag(dr.JitFlag.SymbolicLoops)
            if self.deterministic and not needs.deterministic:
                raise ValueError(f"{INTEGRATOR}: deterministic; expected scenes of smooth dielectrics and conductors")
            if self.deterministic and not symbolic:
                raise ValueError(f"{INTEGRATOR}: deterministic; expected renders that are not differentiated")
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
                area=needs.area,
                environment=needs.environment,
                first_number=needs.both_numbers or not (needs.smooth or self.deterministic),
                second_number=needs.smooth,
                all_of_hit=needs.smooth or needs.textured,
                dispersion=needs.dispersive,
                absorption=needs.absorbing or needs.media or self.camera is not None,
                null=needs.null,
            )

        def _needs(self, scene: Any) -> SceneFeatures:
            """Looked up once a render, as an edit of the scene can change them.

            Another integrator that calls `sample` does not say when a render begins: then they are looked up anew.
            """
            if self.needs is None or not self.rendering:
                self.needs = inspect(scene)
                if self.needs.absorbing:
                    check_wrappers(scene)
                if self.needs.media:
                    self._check_media(scene)
                mi.Log(mi.LogLevel.Info, f"{INTEGRATOR}: left out: {self.left_out()}")  # type: ignore[operator]
            return self.needs

        def _check_media(self, scene: Any) -> None:
            for sensor in scene.sensors():
                if (medium := sensor.get_medium()) is not None and not absorbs_only(v, medium):
                    raise ValueError(
                        f"{INTEGRATOR}: the sensor's medium scatters or varies; expected a homogeneous medium with an "
                        "albedo of 0"
                    )
            check_media(v, scene)

        def left_out(self) -> str:
            """What was left out of the scene rendered last, each feature with the reason."""
            if self.needs is None:
                return "no scene seen yet"
            return "; ".join(f"{feature} ({reason})" for feature, reason in self.needs.left_out.items()) or "nothing"

        def to_string(self) -> str:
            depth = -1 if self.max_depth == UNLIMITED else self.max_depth
            lines = [f"max_depth = {depth}", f"rr_depth = {self.rr_depth}", f"hide_emitters = {self.hide_emitters}"]
            lines += [f"{name} = {getattr(self, name)}" for name in ("split_depth", "split_weight", "deterministic")]
            return "RefractPath[\n" + "".join(f"  {x},\n" for x in [*lines, f"left out = {self.left_out()}"]) + "]"

    return RefractPath


def register(variant: Any) -> None:
    """Make `refract_path` known to one variant, given its module. Registering again is harmless."""
    variant.register_integrator(INTEGRATOR, integrator_class(variant))
