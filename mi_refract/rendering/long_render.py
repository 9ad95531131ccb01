"""A render in passes, which resumes from a checkpoint or a finished image and ends at the first limit that it reaches.

`resume` loads the scene and the existing passes of its image. `LongRender.run` renders pass after pass, writes a
checkpoint every 25 s, and estimates the error after 8, 12, 16, 24 … passes.
"""

from __future__ import annotations

import gc
import hashlib
import json
import math
import os
import platform
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refract import backend
from mi_refract.cluster import on_worker
from mi_refract.io import safe_files
from mi_refract.io.image_file import SUFFIXES, Metadata, installed_version, provenance
from mi_refract.io.safe_files import writable
from mi_refract.io.text import printable
from mi_refract.numerics import Scene
from mi_refract.plugins import defects, follows_media, missing_light, sees_light
from mi_refract.plugins.scene_parser import ParsedScene

from . import checkpoint, rendered_file
from .checkpoint import PASS, PILOT, SETTINGS, CheckpointWriter, Identity, Progress
from .end_conditions import Limits, RelativeError, needed_spp, reached, relative_error, require_interval
from .pass_plan import FEW, FIRST_LANES, LANES, PassPlan, next_stop, plan_passes
from .pass_sums import ARITY, PassSums
from .pilot import Pilot, choose, lines_of
from .render_pass import PassRenderer, pass_renderer
from .render_settings import AUTO, BIASED, OWN, own_settings, parse_settings, settings_text, with_settings
from .scene_files import formulas_in, load_parsed, naming, parse_scene


@dataclass(frozen=True)
class Job:
    """What to render: a scene file, in the present variant, with the scene's first sensor.

    `defines`: values of the scene's `<default>`s. `allow_plugins`: names of plugins that the scene may contain, which
    are code. `settings`: replace those of the scene (see `render_settings`); AUTO: a pilot chooses them.
    """

    scene: Path
    defines: Mapping[str, str] = field(default_factory=dict)
    seed: int = 0
    allow_plugins: Collection[str] = ()
    settings: str = OWN


# Renders passes. Arguments: first, stop, last, offset, spp. Yields level, sums and machines ("a, b") of the nodes that
# make up the passes from `first` to `stop`, in their order. It may begin passes up to `last`, which the next call will
# probably request. `offset`: added to the number of a pass for its seed. `spp`: samples per pixel of each pass.
Passes: TypeAlias = Callable[[int, int, int, int, int], Iterator[tuple[int, PassSums, str]]]


def resume(
    job: Job, output: str | os.PathLike[str], limits: Limits | None = None, *, restart: bool = False
) -> LongRender:
    """Load the scene, and without `restart` its checkpoint or finished image; return the render that continues it.

    ValueError or OSError, one line, for every error that can be found before the first pass.
    """
    path, limits = writable(output, SUFFIXES), limits or Limits()
    if not 0 <= job.seed < 2**32:
        raise ValueError(f"seed = {job.seed}; expected a whole number from 0 to 2³² − 1")
    if limits.until is not None:
        require_interval()
    settings = job.settings if job.settings == AUTO else settings_text(parse_settings(job.settings))
    parsed = parse_scene(job.scene, job.defines)
    scene = load_parsed(parsed, job.allow_plugins)
    renderer = pass_renderer(scene, job.seed)
    spp = limits.spp
    if spp is None and not limits.open_ended:
        spp = int(scene.sensors()[0].sampler().sample_count())
        if spp < 1:
            raise ValueError(f"{job.scene}: the sampler's sample_count = {spp}; expected 1 or more, or --spp")

    identity, saved, image = _identity(job, parsed, renderer, settings), checkpoint.path_of(path), None
    progress = Progress(identity)
    if has_checkpoint := saved.exists() and not restart:
        progress = checkpoint.read(saved, identity, (*renderer.size[::-1], len(renderer.channels)))
    elif not restart:
        image = rendered_file.read(path, renderer.channels, renderer.size, identity)
        progress = image or progress
    pilot_seconds, start = None, time.monotonic()
    if progress.identity[SETTINGS] == AUTO:
        progress.identity |= _choose(job, parsed, renderer, None if limits.by_error else spp, limits)
        pilot_seconds = time.monotonic() - start
    if chosen := parse_settings(progress.identity[SETTINGS]):
        parsed = with_settings(parsed, chosen)
        del scene, renderer
        gc.collect()  # as in `_choose`
        scene = load_parsed(parsed, job.allow_plugins)
        renderer = pass_renderer(scene, job.seed)
    if image is not None:
        too_many = spp is not None and image.done > (_plan(renderer, spp, limits).total or 0)
        # The file lacks Σ w, which few samples may leave near 0: a refined image would keep the error of that mean.
        too_few = renderer.expected is not None and image.done < FEW and (spp is None or image.done < spp)
        if too_many or too_few:
            progress = Progress(progress.identity)
    # Under `until` the size of passes changes; a rest beside former passes belongs to the last size.
    pass_spp = progress.identity.get(PASS) if progress.tree.passes or (progress.base and progress.rest) else None
    if pass_spp and limits.pass_spp not in (None, pass_spp):
        expected = f"expected --pass-spp {pass_spp}, or --restart"
        raise ValueError(f"{saved}: has passes of {pass_spp} samples per pixel; {expected}")
    base = progress.base.spp if progress.base else 0
    plan = _plan(renderer, None if spp is None else max(0, spp - base), limits, pass_spp)
    planned = spp
    if spp is not None and base < spp:
        planned = base + (plan.total or 0)  # may be more than `spp`, where the sampler rounds the last pass up
    if has_checkpoint and planned is not None and progress.done > planned:
        expected = f"expected --spp {progress.done} or more, or --restart"
        raise ValueError(f"{saved}: already holds {progress.done} samples per pixel; {expected}")
    if progress.rest is not None and (progress.tree.passes, progress.rest.spp) != (plan.full_passes, plan.rest):
        progress.rest = None  # the plan has another pass in its place
    last = math.inf if plan.passes is None else progress.first + plan.passes
    if not renderer.jitter and last > max(1, progress.passes):
        expected = "expected jitter, or one pass from the start: --spp N --pass-spp N"
        raise ValueError(f"{job.scene}: the sampler has no jitter, so all passes have points on one grid; {expected}")
    progress.identity[PASS] = plan.spp
    warnings = [f"{job.scene}: {text}" for text in defects(scene)] + _biases(job, parsed, scene)
    return LongRender(job, path, limits, parsed, scene, renderer, spp, plan, progress, pilot_seconds, warnings=warnings)


def _biases(job: Job, parsed: ParsedScene, scene: Scene) -> list[str]:
    """Return a warning if the sampler biases the image. All passes have the same bias, so no stated error contains it.

    In JIT variants `refract_path` takes from the sampler only the numbers of the camera, which have no bias if they are
    the two of a position.
    """
    sampler, camera = own_settings(parsed)["sampler"], scene.sensors()[0]
    more = mi.is_spectral or camera.needs_aperture_sample() or camera.shutter_open_time() > 0
    own_numbers = dr.is_jit_v(mi.Float) and not more and follows_media(scene.integrator())
    if sampler not in BIASED or own_numbers or not sees_light(scene.integrator()):
        return []
    expected = "expected independent, multijitter or orthogonal"
    return [f"{job.scene}: the sampler {sampler} biases the image, which no stated error contains; {expected}"]


def _choose(job: Job, parsed: ParsedScene, renderer: PassRenderer, spp: int | None, limits: Limits) -> Identity:
    """Return what a pilot adds to the identity. `spp`: samples per pixel, None if unknown. Errors: those of `Pilot`."""

    def plan(rounded: Callable[[int], int]) -> PassPlan:
        return _plan(renderer, spp, limits, most=LANES, rounded=rounded)

    gc.collect()  # Dr.Jit compiles every plugin that exists
    try:
        choice = choose(Pilot(parsed, renderer, plan, limits.seconds))
    except RuntimeError as error:  # raised by Mitsuba
        raise ValueError(naming(job.scene, error)) from None
    return {SETTINGS: settings_text(choice.settings), PILOT: choice.figures}


def _plan(
    renderer: PassRenderer,
    total: int | None,
    limits: Limits,
    pass_spp: int | None = None,
    most: int | None = None,
    rounded: Callable[[int], int] | None = None,
) -> PassPlan:
    """Return the plan of `total` samples per pixel.

    `pass_spp`: samples per pixel of a pass, if passes exist; `most`: else, at most. `rounded`: rounds a number of
    samples as a sampler does, by default the scene's own.
    """
    pixels = math.prod(renderer.size)
    if most is None:
        most = FIRST_LANES // pixels if limits.by_error else LANES
    fixed = pass_spp or limits.pass_spp
    return plan_passes(pixels, total, fixed, rounded or renderer.rounded, moments=renderer.moments, most=most)


def _identity(job: Job, parsed: ParsedScene, renderer: PassRenderer, settings: str) -> Identity:
    """Return everything that the bits of a render depend on, by name, except PASS, which the plan determines.

    `parsed`, `renderer`: the scene with its own settings. Error messages contain the names.
    """
    digest = hashlib.sha256(json.dumps(parsed.nodes).encode())
    for name, path in parsed.files(job.allow_plugins).items():
        digest.update(json.dumps([name, hashlib.sha256(path.read_bytes()).hexdigest()]).encode())
    width, height = renderer.size
    llvm = "llvm" in str(mi.variant())
    return {
        "scene": digest.hexdigest(),
        "defines": dict(job.defines),
        "seed": job.seed,
        SETTINGS: settings,
        "variant": str(mi.variant()),
        "film": f"{width} × {height} {', '.join(renderer.channels)}",
        "colours": renderer.colours,
        "version of mi_refract": on_worker.our_version(),
        **{f"version of {name}": installed_version(name) for name in ("mitsuba", "drjit")},
        "libLLVM": backend.llvm().library if llvm else "none",
        "vector width": on_worker.vector_width() if llvm else "none",
    }


@dataclass
class LongRender:
    """A render in passes; `resume` returns it.

    `spp`: samples per pixel at the end, None if only another limit ends the render. `pilot_seconds`: time of the pilot
    that `resume` ran, None if it ran none. `ended_by`: the limit that ended the render, in words. `warnings`: errors
    that did not end the render.
    """

    job: Job
    output: Path
    limits: Limits
    parsed: ParsedScene
    scene: Scene
    renderer: PassRenderer
    spp: int | None
    plan: PassPlan
    progress: Progress
    pilot_seconds: float | None = None
    ended_by: str = ""
    warnings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:  # noqa: D105
        self.checkpoints = CheckpointWriter(self.output, self.progress, self.warnings)
        self._files_before = self._file_stamps()

    def run(self, watch: Callable[[LongRender], None] = lambda render: None, passes: Passes | None = None) -> Metadata:
        """Render the passes that are left, write the image and return its header.

        `watch`: called after every node of passes. `passes`: renders passes, by default in this process. On any error
        the checkpoint keeps all finished passes. BlockingIOError if another process renders into the same file, or has
        done so since `resume`.
        """

        def here(first: int, stop: int, last: int, offset: int, spp: int) -> Iterator[tuple[int, PassSums, str]]:
            for number in range(first, stop):
                yield 0, self.renderer.render(offset + number, spp), platform.node()

        with safe_files.held(lock_of(self.output), "a render", self.output, "another file"):
            if self._file_stamps() != self._files_before:
                text = f"{self.output}: written by another render in the meantime"
                raise BlockingIOError(f"{text}; run the command again")
            self.checkpoints.active = True
            try:
                return self._run(passes or here, watch)
            except BaseException as error:
                self.checkpoints.write()
                if isinstance(error, RuntimeError):  # raised by Mitsuba
                    raise ValueError(naming(self.job.scene, error)) from None
                raise
            finally:
                self.checkpoints.active = False

    def _run(self, nodes: Passes, watch: Callable[[LongRender], None]) -> Metadata:
        progress, done_before = self.progress, self.progress.passes
        seconds = math.inf if self.limits.seconds is None else self.limits.seconds - (self.pilot_seconds or 0)
        deadline = time.monotonic() + seconds
        while not (end := self.end()):
            self._fit_passes()
            tree, plan, first = progress.tree, self.plan, progress.first
            # Render up to the next estimate of the error; passes up to the estimate after it may be begun.
            done, rest = tree.passes, tree.passes == plan.full_passes
            stop = 1 if progress.passes == 0 and self.renderer.moments else next_stop(first + done) - first
            last = next_stop(next_stop(first + done)) - first
            if plan.full_passes is not None:
                last = done + 1 if rest else plan.full_passes
            node_start = time.monotonic()
            spp = plan.rest if rest else plan.spp
            for level, sums, machines in nodes(done, min(stop, last), last, first, spp):
                took = time.monotonic() - node_start
                sums.check((*self.renderer.size[::-1], len(self.renderer.channels)), ARITY**level, spp)
                progress.add(level, sums, machines, took, rest=rest)
                node_start = time.monotonic()
                watch(self)
                self.checkpoints.write_when_due(took)
                if time.monotonic() >= deadline:
                    break
            if time.monotonic() >= deadline:
                end = f"--time {self.limits.seconds:g} s"
                break
        self.ended_by = end
        watch(self)
        self.checkpoints.wait()
        total = progress.sums()
        assert total is not None
        metadata = {
            "mi_refract:variant": str(mi.variant()),
            "mi_refract:seed": self.job.seed,
            "mi_refract:scene": str(self.job.scene),
            "mi_refract:defines": json.dumps(dict(self.job.defines), sort_keys=True),
            "mi_refract:settings": progress.identity[SETTINGS],
            "mi_refract:formulas": ", ".join(formulas_in(self.scene)) or "none",
            "mi_refract:missing": self.missing or "none known",
        }
        metadata |= provenance() | self.renderer.filter_header
        header = rendered_file.header(progress, total, metadata, self.ended_by)
        if progress.passes > done_before or self.checkpoints.path.exists():
            rendered_file.write(self.output, self.renderer.channels, total, header)
        self.checkpoints.path.unlink(missing_ok=True)
        return header

    def end(self) -> str:
        """Return what ends the render now; "" if there are passes left to render."""
        progress, full = self.progress, self.plan.full_passes
        passes = progress.passes
        if passes == 1 or _is_stop(passes):
            sums = progress.sums()
            assert sums is not None
            if reason := reached(self.limits, sums, self.renderer.channels):
                return reason
            colours = sums.total[..., : sums.colours]
            if passes > 1 and self.spp is None and self.limits.by_error and not np.any(colours > 0):
                finite = np.isfinite(colours).any()
                problem = "the image is still black" if finite else "no pixel of the image is finite"
                text = f"{self.output}: {problem}; --until cannot be evaluated"
                if not finite and self.limits.seconds is None:  # pixels do not become finite
                    raise ValueError(f"{text}; expected --spp or --time")
                self.warnings += [] if text in self.warnings else [text]
        missing = full is None or progress.tree.passes < full or (self.plan.rest and progress.rest is None)
        return "" if missing else f"{progress.done} spp"

    def _fit_passes(self) -> None:
        """If the error ends the render, change the size of passes so that the next stop has as many samples as needed.

        These are at least a third more than there are now, so that estimates stay few.
        """
        passes = self.progress.passes
        if self.limits.pass_spp or not self.limits.by_error or not _is_stop(passes):
            return
        sums = self.progress.sums()
        assert sums is not None
        most = max(needed_spp(self.limits, sums) - sums.spp, sums.spp / 3) / (next_stop(passes) - passes)
        left = None if self.spp is None else max(0, self.spp - sums.spp)
        plan = _plan(self.renderer, left, self.limits, most=int(min(most, LANES)))
        if plan.spp != self.plan.spp:
            self.plan = plan
            self.progress.rebase(plan.spp)

    @property
    def missing(self) -> str:
        """The light that the scene's integrator misses, by class of paths: `missing_light` in one line; "" for none."""
        return "; ".join(f"{path_class}: {text}" for path_class, text in missing_light(self.scene).items())

    def error(self) -> RelativeError | None:
        """Return the present error; None before the first pass."""
        sums = self.progress.sums()
        return None if sums is None else relative_error(sums)

    def image(self) -> np.ndarray | None:
        """Return the present image, H × W × channels; None before the first pass."""
        sums = self.progress.sums()
        return None if sums is None else sums.mean

    def pilot_lines(self) -> list[str]:
        """Return lines about the settings that a pilot chose, with figures if this command ran it; [] if none did."""
        settings, figures = (self.progress.identity.get(name) for name in (SETTINGS, PILOT))
        if figures is None:
            return []
        text = settings if settings == OWN else f"--settings {settings}"
        if self.pilot_seconds is None:
            return [f"the pilot of an earlier command has chosen {text}"]
        return [*lines_of(figures), f"a pilot of {figures['seconds']:g} s has chosen {text}"]

    def give_up(self) -> None:
        """Write a checkpoint, report it on stderr and remove the lock file, before a signal ends this process."""
        if not self.checkpoints.active:
            return
        before = len(self.warnings)
        self.checkpoints.write()
        messages = self.warnings[before:]
        if not messages and self.checkpoints.path.exists():
            messages = [f"{self.checkpoints.path}: {self.progress.done} spp; run the same command again to resume"]
        for message in messages:
            os.write(2, f"\nmi-refract: {printable(message)}\n".encode(errors="replace"))
        lock_of(self.output).unlink(missing_ok=True)

    def _file_stamps(self) -> list[tuple[int, int] | None]:
        """Return inode and time of the image and the checkpoint, which change when another render writes them."""
        stamps: list[tuple[int, int] | None] = []
        for path in (self.output, self.checkpoints.path):
            status = path.stat() if path.exists() else None
            stamps.append((status.st_ino, status.st_mtime_ns) if status else None)
        return stamps


def _is_stop(passes: int) -> bool:
    """Return whether the error is estimated after so many passes."""
    return passes > 0 and next_stop(passes - 1) == passes


def render_to_exr(
    scene: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    defines: Mapping[str, str] | None = None,
    spp: int | None = None,
    seed: int = 0,
    allow_plugins: Collection[str] = (),
    settings: str = OWN,
) -> Metadata:
    """Render a scene file from its first pass on, and return the header of the EXR file.

    `defines`: values of the scene's `<default>`s. `spp`: samples per pixel; None: the scene's. `allow_plugins`: names
    of plugins that the scene may contain, which are code. `settings`: replace those of the scene, for example
    "sampler=multijitter,integrator=refract_path,split_depth=2"; "auto": a pilot measures which suit the scene.
    ValueError or OSError in one line, before the rendering if possible; InterruptedError for a rendering that was cut
    short. Then no image is written, and a checkpoint keeps all finished passes.
    """
    job = Job(Path(scene), dict(defines or {}), seed, allow_plugins, settings)
    return resume(job, output, Limits(spp=spp), restart=True).run()


def lock_of(output: Path) -> Path:
    """Return the path of the lock file of a render into this file."""
    return output.with_name(f".{output.name}.lock")
