"""A render in passes: from where it was left, until it has what was asked for.

Each pass is rendered and added to the tree of sums; every 25 s or so a checkpoint is written; after 8, 12, 16, 24 …
passes the error is looked at, where it may end the render.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from mi_refract.io import lock
from mi_refract.io.atomic import writable
from mi_refract.io.image_file import SUFFIXES, Metadata
from mi_refract.io.provenance import provenance
from mi_refract.io.sanitise import printable

from . import checkpoint, error_estimate, rendered_file
from .checkpoint import Progress
from .identity import PASS, identity_of
from .pass_plan import FEW, PassPlan, next_stop, plan_passes
from .pass_sums import PassSums
from .render_pass import PassRenderer, pass_renderer
from .scene_files import formulas_in, load_scene, naming

NO_NOISE = "no noise: the samples of every pixel agree"
# Seconds from one checkpoint's state to the next one's, unless a pass takes longer. A kill loses as many, and those in
# which the next one is written: 30 in all, if that takes up to 5.
BETWEEN_CHECKPOINTS = 25.0


@dataclass(frozen=True)
class Job:
    """What is rendered: the scene in a file, in the present variant, with its first sensor.

    `defines`: values of its `<default>`s. `allow_plugins`: names of plugins that it may bring, which are code.
    """

    scene: Path
    defines: Mapping[str, str] = field(default_factory=dict)
    seed: int = 0
    allow_plugins: Collection[str] = ()


@dataclass(frozen=True)
class Limits:
    """What ends a render: the first of these that is reached.

    `until`, `until_tile`: relative errors, of the image and of its worst tiles; `seconds`: of this run.
    `spp`: samples per pixel; None: as the scene says, where nothing else ends the render. `pass_spp`: those of a pass.
    """

    spp: int | None = None
    until: float | None = None
    until_tile: float | None = None
    seconds: float | None = None
    pass_spp: int | None = None

    def __post_init__(self) -> None:
        """ValueError for what is out of range."""
        for name in ("spp", "pass_spp"):
            if (value := getattr(self, name)) is not None and not 1 <= value < 2**32:
                raise ValueError(f"{name} = {value}; expected a whole number from 1 to 2³² − 1")
        for name in ("until", "until_tile"):
            if (value := getattr(self, name)) is not None and not 0 < value <= 1:
                raise ValueError(f"{name} = {value:g}; expected more than 0 %, up to 100 %")
        if self.seconds is not None and not 0 < self.seconds < float("inf"):
            raise ValueError(f"time = {self.seconds:g} s; expected more than 0")

    @property
    def open_ended(self) -> bool:
        """Whether something else than a number of samples ends the render."""
        return any(limit is not None for limit in (self.until, self.until_tile, self.seconds))


UNLIMITED = Limits()


class Passes(Protocol):
    """Who renders passes."""

    def nodes(self, first: int, stop: int, last: int, offset: int, spp: int) -> Iterator[tuple[int, PassSums, str]]:
        """Level, sums and machines ("a, b") of nodes that make up the passes from `first` to `stop`, in their order.

        Passes up to `last` may be begun, as they will probably be asked for next. `offset`: added to their numbers for
        their seeds. `spp`: samples per pixel of each.
        """
        ...


@dataclass(frozen=True)
class ThisProcess:
    """Renders passes here, one after the other."""

    renderer: PassRenderer

    def nodes(self, first: int, stop: int, last: int, offset: int, spp: int) -> Iterator[tuple[int, PassSums, str]]:
        """Each pass by itself."""
        for number in range(first, stop):
            yield 0, self.renderer.render(offset + number, spp), os.uname().nodename


class LongRender:
    """A job, its limits, and what there is of it: nothing, a checkpoint, or a finished image to go on from."""

    def __init__(
        self, job: Job, output: str | os.PathLike[str], limits: Limits = UNLIMITED, *, restart: bool = False
    ) -> None:
        """Load the scene and look for what there is; with `restart` nothing of it counts.

        ValueError or OSError in one line: what can be known before the first pass.
        """
        self.job, self.limits, self.output = job, limits, writable(output, SUFFIXES)
        if not 0 <= job.seed < 2**32:
            raise ValueError(f"seed = {job.seed}; expected a whole number from 0 to 2³² − 1")
        if limits.until is not None:
            error_estimate.require_interval()
        self.checkpoint = checkpoint.path_of(self.output)
        self.scene = load_scene(job.scene, job.defines, job.allow_plugins)
        self.renderer = pass_renderer(self.scene, job.seed)
        self.spp = limits.spp
        if self.spp is None and not limits.open_ended:
            self.spp = int(self.scene.sensors()[0].sampler().sample_count())
        self.progress = self._found(self._identity(), restart)
        self.plan = self._plan()
        self.progress.identity[PASS] = self.plan.spp
        self.ended_by = ""
        self.warnings: list[str] = []
        self._seen = _stamps(self.output, self.checkpoint)
        self._holds_lock = False
        self._state = threading.Lock()  # held where the progress changes or is written
        self._last_kept = time.monotonic()
        self._writer: threading.Thread | None = None

    def _identity(self) -> dict[str, Any]:
        job = self.job
        return identity_of(job.scene, job.defines, job.seed, self.renderer, job.allow_plugins)

    def _found(self, identity: dict[str, Any], restart: bool) -> Progress:
        if restart:
            return Progress(identity)
        if self.checkpoint.exists():
            found = checkpoint.read(self.checkpoint, identity)
            if self.spp is not None and found.done > self.spp:
                raise ValueError(f"{self.checkpoint}: holds {found.done} spp; expected at least so many, or --restart")
            return found
        image = rendered_file.read(self.output, self.renderer.channels, identity)
        enough = image is not None and (self.spp is None or image.done <= (self._planned(None).total or 0))
        return image if image is not None and enough else Progress(identity)

    def _planned(self, pass_spp: int | None, done: int = 0) -> PassPlan:
        """The passes that follow so many samples per pixel."""
        width, height = self.renderer.size
        total = None if self.spp is None else max(0, self.spp - done)
        return plan_passes(width * height, total, pass_spp, self.renderer.accepted, moments=self.renderer.moments)

    def _plan(self) -> PassPlan:
        """The passes that follow those of the base; of the size that a checkpoint's passes have."""
        recorded, asked = self.progress.identity.get(PASS), self.limits.pass_spp
        if self.progress.rest is not None and self.progress.done != self.spp:
            self.progress.rest = None  # it was the last of fewer samples: a whole pass takes its place
        if self.progress.tree.passes and asked not in (None, recorded):
            raise ValueError(f"{self.checkpoint}: passes of {recorded} samples per pixel; expected those, or --restart")
        begun = recorded if self.progress.tree.passes else None
        return self._planned(begun or asked, self.progress.base.spp if self.progress.base else 0)

    # Rendering --------------------------------------------------------------------------------------------------------

    def run(self, watch: Callable[[LongRender], None] = lambda render: None, passes: Passes | None = None) -> Metadata:
        """Render what is left and write the image; its header. `watch` is called after every node of passes.

        `passes`: who renders them, else this process. On any error what is done is kept in the checkpoint.
        """
        with lock.held(lock_of(self.output), "a render", self.output, "another file"):
            if _stamps(self.output, self.checkpoint) != self._seen:
                raise BlockingIOError(f"{self.output}: another render was there meanwhile; expected to try again")
            self._holds_lock = True
            try:
                return self._run(passes or ThisProcess(self.renderer), watch)
            except BaseException as error:
                self.keep()
                if isinstance(error, RuntimeError):  # Mitsuba's own
                    raise ValueError(naming(self.job.scene, error)) from None
                raise
            finally:
                self._holds_lock = False

    def _run(self, source: Passes, watch: Callable[[LongRender], None]) -> Metadata:
        began = time.monotonic()
        nothing_left = bool(self._end())
        while not (end := self._end()):
            self._advance(source, began, watch)
            if self.limits.seconds is not None and time.monotonic() - began >= self.limits.seconds:
                end = f"--time {self.limits.seconds:g} s"
                break
        self.ended_by = end
        watch(self)
        return self._finish(nothing_left and self.progress.passes == self.progress.first)

    def _advance(self, source: Passes, began: float, watch: Callable[[LongRender], None]) -> None:
        """Render up to where the next look is due, the time is over, or, where no full pass is left, the last pass."""
        tree, full, before = self.progress.tree, self.plan.full_passes, time.monotonic()
        if tree.passes == full:
            self._render_rest(source)
            return
        first = self.progress.first
        last = full if full is not None else next_stop(next_stop(first + tree.passes)) - first
        stop = min(self._next_look(), last)
        for level, sums, machine in source.nodes(tree.passes, stop, last, first, self.plan.spp):
            took = time.monotonic() - before
            with self._state:
                tree.add(sums, level)
                self.progress.seconds += took
                self.progress.machines = sorted({*self.progress.machines, *machine.split(", ")})
            before = time.monotonic()
            watch(self)
            self._keep_sometimes(took)
            if self.limits.seconds is not None and time.monotonic() - began >= self.limits.seconds:
                return

    def _render_rest(self, source: Passes) -> None:
        """The last pass, which has fewer samples than the others."""
        before, number = time.monotonic(), self.plan.full_passes or 0
        [(_, sums, machine)] = source.nodes(number, number + 1, number + 1, self.progress.first, self.plan.rest)
        with self._state:
            self.progress.rest = sums
            self.progress.machines = sorted({*self.progress.machines, *machine.split(", ")})
            self.progress.seconds += time.monotonic() - before

    def _next_look(self) -> int:
        """After how many passes of the tree the next look is due."""
        passes, first = self.progress.passes, self.progress.first
        return 1 if passes == 0 and self.renderer.moments else next_stop(passes) - first

    def _end(self) -> str:
        """What ends the render with what there is; "" where it goes on."""
        tree, full = self.progress.tree, self.plan.full_passes
        if not tree.passes and self.progress.base and self.progress.base_ended_by == NO_NOISE:
            return NO_NOISE
        passes = self.progress.passes
        due = passes == 1 or (passes and next_stop(passes - 1) == passes)
        if due and (reason := self._good_enough()):
            return reason
        missing = full is None or tree.passes < full or (self.plan.rest and self.progress.rest is None)
        return "" if missing else f"{self.progress.done} spp"

    def _good_enough(self) -> str:
        """What ends the render by what its samples are: no noise, or an error that was asked for; "" where nothing."""
        if self.progress.passes < FEW and self.progress.done < error_estimate.ENOUGH_FOR_NO_NOISE:
            return ""
        sums = self.progress.sums()
        if sums is None:
            return ""
        if error_estimate.without_noise(sums):
            return NO_NOISE
        if self.spp is None and not np.any(sums.total[..., : sums.colours] > 0):
            self._warn_once(f"{self.output}: the image is still black; --until cannot be evaluated")
        if self.progress.passes < FEW:
            return ""
        if self.limits.until and (error := error_estimate.relative_error(sums)).high <= self.limits.until:
            asked, value, high = (f"{100 * each:.3g} %" for each in (self.limits.until, error.value, error.high))
            return f"--until {asked}: the error is {value}, at most {high}"
        if self.limits.until_tile and (worst := error_estimate.worst_tile(sums)) <= self.limits.until_tile:
            asked, value = (f"{100 * each:.3g} %" for each in (self.limits.until_tile, worst))
            return f"--until-tile {asked}: the error of the worst tile is {value}"
        return ""

    def _warn_once(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    @property
    def is_done(self) -> bool:
        """Whether nothing is left to render."""
        return bool(self._end())

    @property
    def has_all_samples(self) -> bool:
        """Whether it has as many samples per pixel as were asked for."""
        return self.progress.done == self.spp

    def error(self) -> error_estimate.RelativeError | None:
        """The present error; None where nothing is done yet."""
        with self._state:
            sums = self.progress.sums()
        return None if sums is None else error_estimate.relative_error(sums)

    def image(self) -> np.ndarray | None:
        """The image so far, H × W × channels; None where nothing is done yet."""
        with self._state:
            sums = self.progress.sums()
        return None if sums is None else sums.mean

    def _finish(self, unchanged: bool) -> Metadata:
        self._wait()
        metadata = _metadata(self.job, ", ".join(formulas_in(self.scene)) or "none")
        sums = self.progress.sums()
        assert sums is not None
        header = rendered_file.header(self.progress, sums, metadata | self.renderer.filter_header, self.ended_by)
        if not unchanged:
            rendered_file.write(self.output, self.renderer.channels, sums, header)
        self.checkpoint.unlink(missing_ok=True)
        return header

    # Checkpoints ------------------------------------------------------------------------------------------------------

    def keep(self) -> None:
        """Write a checkpoint of what is done, if anything is. A failure is a warning: the render goes on without."""
        with self._state:
            new = self.progress.tree.passes or self.progress.rest
            if not self._holds_lock or not new:
                return
            try:
                checkpoint.write(self.checkpoint, self.progress)
            except OSError as error:
                self.warnings.append(f"{self.checkpoint}: no checkpoint: {error.strerror or error}; tried again later")

    def give_up(self) -> None:
        """For a process that is about to end while it renders: keep what is done, say so on stderr, leave no lock."""
        if self._holds_lock:
            before = len(self.warnings)
            self.keep()
            said = self.warnings[before:]
            if not said and self.checkpoint.exists():
                said = [f"{self.checkpoint}: {self.progress.done} spp; run the same command again to resume"]
            for text in said:
                os.write(2, f"\nmi-refract: {printable(text)}\n".encode(errors="replace"))
            lock_of(self.output).unlink(missing_ok=True)

    def _keep_sometimes(self, took: float) -> None:
        """Write a checkpoint beside the next pass, if the last one would be old after it. `took`: such a pass."""
        self._wait()
        if time.monotonic() - self._last_kept + took > BETWEEN_CHECKPOINTS:
            self._last_kept = time.monotonic()
            self._writer = threading.Thread(target=self.keep, name="checkpoint")
            self._writer.start()

    def _wait(self) -> None:
        if self._writer is not None:
            self._writer.join()
            self._writer = None


def render_to_exr(
    scene: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    defines: Mapping[str, str] | None = None,
    spp: int | None = None,
    seed: int = 0,
    allow_plugins: Collection[str] = (),
) -> Metadata:
    """Render a scene file from its first pass on, and return the header of the EXR file.

    `defines`: values for the scene's `<default>`s. `spp`: samples per pixel; None: what the scene says.
    `allow_plugins`: names of plugins that the scene may bring, which are code. ValueError or OSError in one line,
    before the rendering where possible; InterruptedError for a rendering that was cut short. No image is written then,
    and what is done is kept in a checkpoint.
    """
    job = Job(Path(scene), dict(defines or {}), seed, allow_plugins)
    return LongRender(job, output, Limits(spp=spp), restart=True).run()


def _stamps(*paths: Path) -> list[tuple[int, int] | None]:
    """What changes with each of the files."""
    found = [path.stat() if path.exists() else None for path in paths]
    return [None if each is None else (each.st_ino, each.st_mtime_ns) for each in found]


def lock_of(output: Path) -> Path:
    """The lock of a render into this file."""
    return output.with_name(f".{output.name}.lock")


def _metadata(job: Job, formulas: str) -> Metadata:
    import mitsuba as mi

    return provenance() | {
        "mi_refract:variant": str(mi.variant()),
        "mi_refract:seed": job.seed,
        "mi_refract:scene": str(job.scene),
        "mi_refract:defines": json.dumps(dict(job.defines), sort_keys=True),
        "mi_refract:formulas": formulas,
    }
