"""The paths of a planar scene: partial reflections split each ray into a tree of paths."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .scene_file import PlanarScene, spaced
from .segments import REFLECT_BITS, Array, Event, Paths, Segments
from .tracer import Tracer

LEAST = 1e-3  # smallest share of a ray's power that a partial reflection must exceed to be followed
MOST = 2**25  # largest number of legs of all paths of all colours: 1.3 GB


@dataclass(frozen=True)
class Branches:
    """P paths of N rays, sorted by the number of their partial reflections.

    paths: with weights and indices. rays: P, the number of each path's ray. reflect: P, bit j is set if the path
    takes the partial reflection at the j-th boundary it meets; no two paths of a ray have the same bits.
    """

    paths: Paths
    rays: NDArray[np.intp]
    reflect: NDArray[np.uint32]

    @property
    def weights(self) -> Array:
        """P × (D+1), as in `paths`."""
        assert self.paths.weights is not None
        return self.paths.weights

    @property
    def first(self) -> NDArray[np.intp]:
        """P: the number of the first leg that belongs to this path; the legs before it are those of another path."""
        return np.asarray(np.frexp(self.reflect.astype(float))[1], np.intp)

    @property
    def own(self) -> NDArray[np.bool_]:
        """P × (D+1): whether leg j exists and belongs to this path; so does the event at its end."""
        events = self.paths.events
        return np.asarray((events != Event.NONE) & (np.arange(events.shape[1]) >= self.first[:, None]))

    @property
    def last(self) -> NDArray[np.intp]:
        """P: the number of the last leg."""
        return np.asarray(np.count_nonzero(self.paths.events, axis=1) - 1)

    @property
    def end(self) -> NDArray[np.uint8]:
        """P: the event that ended the path."""
        return self.paths.events[np.arange(len(self.rays)), self.last]

    @property
    def tips(self) -> Array:
        """P × 2: where the path met its last boundary, or its origin."""
        places = np.isfinite(self.paths.points[..., 0]).sum(axis=1)
        return np.asarray(self.paths.points[np.arange(len(self.rays)), places - 1])


def follow(
    segments: Segments,
    origins: Array,
    directions: Array,
    max_depth: int,
    branches: int = 0,
    *,
    least: float = LEAST,
    most: int = MOST,
    taken: int = 0,
    **how: Any,
) -> Branches:
    """Follow rays (N × 2) with up to `branches` partial reflections, each of more than `least` of the ray's power.

    how: formula, precision, backend, as for `planar.trace`. Only the first 32 boundaries of a path reflect in part.
    ValueError as for `planar.trace`, for a negative number of branches, and, before any path is traced, for more than
    `most` legs, including the `taken` legs of other colours.
    """
    if branches < 0:
        raise ValueError(f"branches = {branches}; expected a whole number from 0")
    trace = Tracer(segments, **how)
    rays, reflect = np.arange(len(origins)), np.zeros(len(origins), np.uint32)
    orders: list[Branches] = []  # by number of partial reflections
    while True:
        paths_so_far = rays.size + sum(len(order.rays) for order in orders)
        _check_size(paths_so_far, max_depth, len(orders), most, taken)
        paths = trace(origins[rays], directions[rays], max_depth, reflect=reflect, weights=True)
        orders.append(Branches(paths, rays, reflect))
        weights, events = orders[-1].weights, paths.events[:, :-1]
        splits = orders[-1].own[:, :-1] & (events == Event.REFRACTED)
        splits[:, REFLECT_BITS:] = False
        with np.errstate(invalid="ignore"):
            parent, boundary = np.nonzero(splits & (weights[:, :-1] - weights[:, 1:] > least))
        if len(orders) > branches or not parent.size:
            break
        rays, reflect = rays[parent], reflect[parent] | (np.uint32(1) << boundary.astype(np.uint32))
    columns = {f.name: np.concatenate([getattr(o.paths, f.name) for o in orders]) for f in fields(Paths)}
    rays, reflect = np.concatenate([o.rays for o in orders]), np.concatenate([o.reflect for o in orders])
    return Branches(Paths(**columns), rays, reflect)


def _check_size(paths: int, max_depth: int, reflections: int, most: int = MOST, taken: int = 0) -> None:
    if paths * (max_depth + 1) > most - taken:
        size = f"{paths} paths of up to {max_depth} boundaries with up to {reflections} partial reflections"
        others = f", including {taken} of other colours" if taken else ""
        raise ValueError(f"{size}; expected fewer rays, branches or boundaries, up to {most} legs in total{others}")


def follow_scene(scene: PlanarScene, *, most: int = MOST, **how: Any) -> tuple[Branches, ...]:
    """The paths of a scene, one `Branches` per colour.

    Options and errors as for `follow`; `most` limits the legs of all colours together.
    """
    _check_size(len(scene.origins) * len(scene.segments), scene.max_depth, 0, most)
    rays = scene.origins, scene.directions, scene.max_depth, scene.branches
    traced: list[Branches] = []
    for segments in scene.segments:
        taken = sum(branches.paths.events.size for branches in traced)
        traced.append(follow(segments, *rays, most=most, taken=taken, **how))
    return tuple(traced)


def with_rays(scene: PlanarScene, count: int) -> PlanarScene:
    """The scene with `count` rays in each beam of two rays or more; their origins and angles are interpolated.

    A single ray is in the middle, as in a scene file.

    ValueError for more rays than `follow` accepts.
    """
    sizes = np.bincount(scene.beams).tolist()
    _check_size(sum(count if size > 1 else size for size in sizes), scene.max_depth, 0)
    parts = []
    for beam in np.unique(scene.beams):
        origins, directions = scene.origins[scene.beams == beam], scene.directions[scene.beams == beam]
        old = np.arange(len(origins))
        new = spaced(0, old[-1], count) if len(old) > 1 else old
        angles = np.interp(new, old, np.unwrap(np.arctan2(directions[:, 1], directions[:, 0])))
        fan = scene.fans[beam] if scene.fans else None
        if fan and len(old) > 1:  # the direction of rotation is unknown from rays 180° or more apart
            angles = np.radians(spaced(fan[0], fan[1], len(new)))
        places = np.column_stack([np.interp(new, old, x) for x in origins.T])
        parts.append((places, np.column_stack([np.cos(angles), np.sin(angles)]), np.full(len(new), beam)))
    origins, directions, beams = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return replace(scene, origins=origins, directions=directions, beams=beams)


# Summaries -------------------------------------------------------------------------------------------------------


def count(traced: Sequence[Branches]) -> Counter[str]:
    """The number of events by name. Legs that paths share count once; REFLECTED counts total reflections only."""
    total: Counter[str] = Counter()
    for branches in traced:
        events = branches.paths.events[branches.own]
        total.update({event.name: int(np.count_nonzero(events == event)) for event in Event})
    return total


def summary(scene: PlanarScene, traced: Sequence[Branches]) -> str:
    """One line: the number of rays and of each event that occurred."""
    n = count(traced)
    rays, paths = len(scene.origins), sum(len(branches.rays) for branches in traced)
    colours = f" in {len(traced)} colours" if len(traced) > 1 else ""
    path_count = [f"{paths} paths"] if paths > rays * len(traced) else []
    events = {
        "reflected totally": n["REFLECTED"],
        "escaped": n["ESCAPED"],
        "stopped at max_depth": n["MAX_DEPTH"],
        "stopped by a medium mismatch": n["MEDIUM_MISMATCH"],
    }
    hits = _plural(n["REFRACTED"] + n["REFLECTED"] + n["MEDIUM_MISMATCH"], "hit")
    event_counts = [f"{number} {event}" for event, number in events.items() if number]
    return ", ".join([_plural(rays, "ray") + colours, *path_count, hits, *event_counts])


def mismatches(scene: PlanarScene, traced: Sequence[Branches]) -> list[str]:
    """A line for each of the three pairs of shapes between which the most paths ended with MEDIUM_MISMATCH."""
    path_counts: Counter[tuple[str, ...]] = Counter()
    examples: dict[tuple[str, ...], str] = {}
    for segments, branches in zip(scene.segments, traced, strict=True):
        ends, last = np.flatnonzero(branches.end == Event.MEDIUM_MISMATCH), branches.last
        indices = branches.paths.indices
        assert indices is not None
        # The last two boundaries of each path; no path ends with a mismatch at its first boundary.
        hits = np.stack([branches.paths.hits[ends, last[ends] - j] for j in (1, 0)], axis=1)
        unique_hits = np.unique(hits, axis=0, return_index=True, return_counts=True)
        for (before, at), j, number in zip(*unique_hits, strict=True):
            pair = tuple(sorted({scene.shape_names[before], scene.shape_names[at]}))
            path_counts[pair] += int(number)
            media = f"between {segments.n_left[at]:.6g} and {segments.n_right[at]:.6g}"
            examples.setdefault(pair, f"in index {indices[ends[j], last[ends[j]]]:.6g} met a boundary {media}")
    fault = "overlap, share part of an edge, leave a gap, or are turned round"
    return [
        f"{' and '.join(pair)} {fault}: {_plural(number, 'path')} {examples[pair]}"
        for pair, number in path_counts.most_common(3)
    ]


def _plural(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def as_data(scene: PlanarScene, traced: Sequence[Branches]) -> dict[str, Any]:
    """The JSON output of `mi-refract trace --json`: the paths per colour, without padding; null for unknown numbers."""
    names, wavelengths = scene.light.names, scene.light.wavelengths or (None,) * len(scene.light)
    colours = []
    for name, wavelength, branches in zip(names, wavelengths, traced, strict=True):
        paths, indices, polarised = branches.paths, branches.paths.indices, branches.paths.polarised
        assert indices is not None and polarised is not None
        path_data: list[dict[str, Any]] = [
            {
                "ray": int(ray),
                "beam": int(scene.beams[ray]),
                "reflect": int(branches.reflect[i]),
                "points": paths.points[i][np.isfinite(paths.points[i][:, 0])].tolist(),
                "direction": paths.directions[i].tolist(),
                "hits": paths.hits[i, paths.hits[i] >= 0].tolist(),
                "events": [Event(event).name.lower() for event in paths.events[i, : last + 1]],
                "indices": _nullable(indices[i, : last + 1]),
                "weights": _nullable(branches.weights[i, : last + 1]),
                "polarised": {wave: _nullable(polarised[i, : last + 1, j]) for j, wave in enumerate(("s", "p"))},
            }
            for i, (ray, last) in enumerate(zip(branches.rays, branches.last, strict=True))
        ]
        colours.append({"colour": name or None, "wavelength": wavelength, "paths": path_data})
    return {
        "scene": str(scene.path),
        "title": scene.title,
        "max_depth": scene.max_depth,
        "branches": scene.branches,
        "counts": {name.lower(): number for name, number in count(traced).items() if name != "NONE"},
        "colours": colours,
    }


def _nullable(numbers: Array) -> list[float | None]:
    return [x if np.isfinite(x) else None for x in numbers.tolist()]
