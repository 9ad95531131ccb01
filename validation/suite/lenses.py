"""The focal shift of an achromat by lens designers' ray tracers, with the same indices and with those of their glasses.

The achromat is that of `scenes/planar/achromat.toml`, made of N-BK7 and F2, at its six wavelengths. The sequential
traces of rayoptics and optiland (float64) and the planar trace of this package compute where rays close to the axis and
at the edge cross the axis. Each is compared with a trace in 80 decimals for the indices that it used, so that different
indices do not count as errors of the trace. With the same indices, only rounding errors remain; the bound adds all of
them at their worst, to first order. In a second case each system takes the glasses by name from its own catalogue, and
the indices are compared as well.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass, replace
from decimal import Decimal

import numpy as np

from mi_refract.media import LINES
from mi_refract.planar import scene_file
from mi_refract.planar.path_tree import follow_scene
from mi_refract.report.row import Row
from validation import limits
from validation.reference.exact_lens import ACHROMAT, START, Rounding, bound, crossing, on_axis
from validation.run.context import SCENES, Context
from validation.run.metrics import ERROR_OVER_BOUND
from validation.study import Study, Task, about

from .renderers import SYSTEMS, System, environments

NAME = "achromat by others"
FILE = SCENES / "planar" / "achromat.toml"
GLASSES = ("SCHOTT", "N-BK7"), ("SCHOTT", "F2")
RADIUS = 12.5  # the rim of the lens in the file
HEIGHTS = (1e-3, 10.0)  # distances of the rays from the axis: close to it, and at the edge
GIVEN, OWN = "same indices", "own glasses"
U = 2.0**-53
OFF, INDEX_OFF, FOCUS_OFF, SHIFT_OFF = "relative error", "index off", "focus off", "shift off"
TERMS = {
    OFF: "the largest relative error of the distance from the first vertex to the crossing, against the exact trace",
    ERROR_OVER_BOUND: "the largest error over the bound of its ray",
    INDEX_OFF: "the largest relative difference between the system's index of a glass and that of the file",
    FOCUS_OFF: "the largest relative difference between the system's crossing and that of the planar trace",
    SHIFT_OFF: "the largest difference between its focal shifts and those of the planar trace, over the largest shift",
    "unanswered": "1 if the program crashed, hung or returned no numbers",
    GIVEN: "all systems use the indices of `mi_refract.media`",
    OWN: "each system looks up the glasses by name",
}


# The sine after a surface is k sin + γ sin_n. The relative errors of γ = k cos − cos_t and of a normal's sine are up to
# 7u and 1u.
THEIRS = Rounding(8.0, 8.0, 0.0, (1.0, 1.0, 1.0))


# An arc is stored as its ends and its control point, each rounded, so its curvature has the relative error of its sag.
# The axis of its conic is rounded as well, so a normal on the axis may turn by a few u.
SAGS = [abs(c) * RADIUS**2 / 2 for c in ACHROMAT.curvatures]
OURS = Rounding(0.0, 0.0, 16.0, [4 * (v + sag) / sag for v, sag in zip(ACHROMAT.vertices, SAGS, strict=True)])


@dataclass(frozen=True)
class Answer:
    """A system's version, indices (glasses, wavelengths), and by case rays [z, y, dz, dy] after the lens.

    Rays have the shape (wavelengths, heights, 4).
    """

    system: str
    indices: np.ndarray
    rays: dict[str, np.ndarray]


def tasks(context: Context) -> list[Task]:
    """Return one task for the planar trace, and one per system that traces lenses."""
    others = [system for system in SYSTEMS.values() if system.lens]
    own = Task("achromat: the planar trace", planar_rows)
    return [own, *(Task(f"achromat: {s.title}", functools.partial(system_rows, s, context)) for s in others)]


def planar_rows() -> list[Row]:
    """Return a row per height: the error of this package's planar trace."""
    rays, indices = planar()
    return [_row("planar trace", GIVEN, i, rays, indices, OURS) for i in range(len(HEIGHTS))]


def system_rows(system: System, context: Context) -> list[Row]:
    """Return a row per case and height, or one row with the reason why there are none."""
    row = functools.partial(Row, NAME, system.title, "every ray", "float64")

    def answer() -> Answer:
        return parsed(environments.ask(system, system.lens, json.dumps(question())))

    reason = environments.why_not(system, context.profile.name)
    answer_or_none, no_answer = environments.attempt(row, reason, ("unanswered", 1), answer)
    return no_answer if answer_or_none is None else answer_rows(system.title, answer_or_none)


def answer_rows(title: str, answer: Answer) -> list[Row]:
    """Return the rows of an answer."""
    ours, indices = planar()
    index_off = float(np.abs(answer.indices / indices - 1).max())
    rows = []
    for i in range(len(HEIGHTS)):
        for case in (GIVEN, OWN):
            used = indices if case == GIVEN else answer.indices
            their_crossings, our_crossings = on_axis(answer.rays[case][:, i]), on_axis(ours[:, i])
            row = _row(title, case, i, answer.rays[case], used, THEIRS)
            shifts, expected = (x - x[wavelengths().index(LINES["d"])] for x in (their_crossings, our_crossings))
            values = {FOCUS_OFF: float(np.abs(their_crossings / our_crossings - 1).max())}
            values[SHIFT_OFF] = float(np.abs(shifts - expected).max() / np.abs(expected).max())
            budgets = {}
            if case == OWN:
                values[INDEX_OFF], budgets[INDEX_OFF] = index_off, limits.CATALOG_FORMULA
            values, budgets = row.values | values, row.budgets | budgets
            rows.append(replace(row, values=values, budgets=budgets, reason=answer.system))
    return rows


def _row(title: str, case: str, i: int, rays: np.ndarray, indices: np.ndarray, rounding: Rounding) -> Row:
    """Return the row of rays at height `HEIGHTS[i]`: errors against the exact trace for these indices; focal shifts."""
    height, crossings = HEIGHTS[i], on_axis(rays[:, i]).tolist()
    exact = [crossing(ACHROMAT, (1.0, *n, 1.0), height, START) for n in indices.T.tolist()]
    off = [float(abs(Decimal(x) - e.place)) for x, e in zip(crossings, exact, strict=True)]
    at = dict(zip(wavelengths(), crossings, strict=True))
    values = {
        OFF: float(np.max([x / float(e.place) for x, e in zip(off, exact, strict=True)])),
        ERROR_OVER_BOUND: float(np.max([x / bound(ACHROMAT, e, rounding, U) for x, e in zip(off, exact, strict=True)])),
        f"at {LINES['d']:g} nm": at[LINES["d"]],
    }
    values |= {f"shift at {w:g} nm": x - at[LINES["d"]] for w, x in at.items() if w != LINES["d"]}
    replay = {"height": height, "glasses": [":".join(glass) for glass in GLASSES], "indices": indices.tolist()}
    budgets = {ERROR_OVER_BOUND: limits.LENS_TRACE}
    return Row(NAME, title, f"{case}, height {height:g}", "float64", values, budgets, replay=replay)


@functools.cache
def planar() -> tuple[np.ndarray, np.ndarray]:
    """Return rays (wavelengths, heights, 4) by the planar trace, as in `Answer`, and indices (glasses, wavelengths)."""
    origins, directions = np.array([[START, height] for height in HEIGHTS]), np.tile([1.0, 0.0], (len(HEIGHTS), 1))
    beams = np.zeros(len(HEIGHTS), int)
    scene, rays = replace(scene_file.load(FILE), origins=origins, directions=directions, beams=beams), []
    for segments in scene.segments:
        (traced,) = follow_scene(replace(scene, segments=(segments,)))
        order = np.argsort(traced.rays)
        rays.append(np.concatenate([traced.tips, traced.paths.directions], axis=1)[order])
    return np.array(rays), np.array([region.indices for region in scene.regions])


def wavelengths() -> tuple[float, ...]:
    """Return the wavelengths of the file, in nm."""
    return scene_file.load(FILE).light.wavelengths


def question() -> dict[str, object]:
    """Return what a system's script reads on stdin, as JSON."""
    return {
        "curvatures": ACHROMAT.curvatures,
        "thicknesses": ACHROMAT.thicknesses,
        "start": START,
        "heights": HEIGHTS,
        "wavelengths": wavelengths(),
        "glasses": GLASSES,
        "indices": planar()[1].tolist(),
    }


def parsed(text: str) -> Answer:
    """Parse a script's output. ValueError, one line, unless it holds finite numbers in the expected shapes."""
    rays_shape, indices_shape = (len(wavelengths()), len(HEIGHTS), 4), (len(GLASSES), len(wavelengths()))
    try:
        data = json.loads(text)
        indices = np.array(data["indices"], float)
        rays = {case: np.array(data["rays"][key], float) for case, key in ((GIVEN, "given"), (OWN, "own"))}
        system = str(data["system"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"no answer: {error!r}; expected system, indices and rays in JSON") from None
    shapes = [x.shape for x in (indices, *rays.values())]
    if shapes != [indices_shape, rays_shape, rays_shape]:
        raise ValueError(f"numbers of shape {shapes}; expected {indices_shape}, and {rays_shape} twice")
    if not all(np.isfinite(x).all() for x in (indices, *rays.values())):
        raise ValueError("a number that is not finite; expected the rays after the lens")
    return Answer(system, indices, rays)


STUDY = Study(NAME, "An achromat by others", about(__doc__), TERMS, tasks)
