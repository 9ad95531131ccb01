"""Glasses by name and wavelength in lens designers' ray tracers: are their indices and their directions right?

Rays pass between glasses and air at six wavelengths; `mi-refract rays export --medium … --wavelengths …` writes such
rays. A program looks up its own index for each medium and wavelength, refracts the ray, and returns the direction and
the ratio of indices that it used. The direction is judged for that ratio, by the a-priori bound of the textbook formula
for the ray. Indices are compared with those of `mi_refract.media`, glass by glass. Programs that evaluate the same
formula with the same coefficients differ by rounding only. If a program has another edition or another fit of a maker's
catalogue, its row says so: the difference was recorded, and a difference above 1e-5, the precision that makers print,
misses a goal. rayoptics reads the makers' tables that this package has its coefficients from, through opticalglass;
optiland and raysect have tables of their own. batoid has no catalogue, but a telescope with two named glasses.
"""

from __future__ import annotations

import functools

import numpy as np

from mi_refract.ray_sets import check_answers, header, ray_set
from mi_refract.ray_sets.check_answers import UNFIT
from mi_refract.ray_sets.files import as_csv, parse_answers
from mi_refract.ray_sets.ray_set import Answers, RaySet
from mi_refract.report.row import Row
from validation import limits, repeated
from validation.run import seeds
from validation.run.context import Context
from validation.run.metrics import ERROR_OVER_BOUND, MISCLASSIFIED, WORST_ANGLE
from validation.study import Study, Task, about

from . import per_ray
from .per_ray import OFF_RECORDED, OTHER_SIGNAL, RECORDED, off_recorded
from .renderers import SYSTEMS, System, environments
from .renderers.glass_catalogues import CATALOGUES, GlassCatalogue

NAME = "glasses by others"
SEED, COUNT = 2041, 660  # rays of each regime
REGIMES = ("generic", "near-normal", "grazing", "critical", "Brewster")
WAVELENGTHS = (435.8343, 486.1327, 546.074, 587.5618, 656.2725, 706.5188)  # nm
INDEX_OFF = "index off"
TERMS = {
    INDEX_OFF: "the largest relative difference between the ratio of indices used and that of `mi_refract.media`",
    RECORDED: "that difference as recorded earlier, for a program with other data",
    OFF_RECORDED: "the ratio of the two, or its reciprocal if that is larger",
    WORST_ANGLE: "the largest angle to the certified direction for the ratio used, without misclassified rays",
    **{name: per_ray.TERMS[name] for name in (ERROR_OVER_BOUND, MISCLASSIFIED, "wrong", "unfit", OTHER_SIGNAL)},
    "unanswered": "rays without an answer, because the program crashed, hung, or returned no indices",
}


def tasks(context: Context) -> list[Task]:
    """Return one task per system that has glasses."""
    return [
        Task(f"glasses: {SYSTEMS[name].title}", functools.partial(system_rows, SYSTEMS[name], catalogue, context))
        for name, catalogue in CATALOGUES.items()
    ]


def system_rows(system: System, catalogue: GlassCatalogue, context: Context) -> list[Row]:
    """Return a row per regime and per glass, or one row with the reason why there are none."""
    row = functools.partial(Row, NAME, system.title, "every glass", "f64")
    rays, reason = rays_for(catalogue.glasses), environments.why_not(system, context.profile.name)

    def answer() -> Answers:
        text = environments.run(environments.script(system, catalogue.script, "glasses"), as_csv(rays))
        answers = parse_answers(text, system.title)
        if answers.n_ratio is None:
            raise ValueError("no column n_ratio; expected the ratio of indices used")
        return answers

    answers, no_answer = environments.attempt(row, reason, ("unanswered", len(rays)), answer)
    return no_answer if answers is None else rows(system.title, catalogue, rays, answers)


@seeds.cached
def rays_for(glasses: tuple[str, ...]) -> RaySet:
    """Return the rays for a system that has these glasses."""
    return ray_set.make(REGIMES, COUNT, "f64", seeds.current(SEED), media=glasses, wavelengths=WAVELENGTHS)


def rows(title: str, catalogue: GlassCatalogue, rays: RaySet, answers: Answers) -> list[Row]:
    """Return a row of directions per regime, then a row of indices per glass."""
    findings = check_answers.check(rays, answers)
    version = str(answers.header.get("system", ""))
    made = []
    errors_of = {regime.regime: regime for regime in findings.regimes}
    for name in REGIMES:
        values, budgets = {"unfit": float(findings.problem_count(*UNFIT))}, {"unfit": 0.0, "wrong": 0.0}
        errors = errors_of.get(name)
        if errors is None:
            made.append(Row(NAME, title, name, "f64", values | {"wrong": np.nan}, budgets, reason=version))
            continue
        values |= {WORST_ANGLE: errors.worst, "p99 rad": errors.p99, ERROR_OVER_BOUND: errors.error_over_bound}
        values |= {MISCLASSIFIED: float(errors.tir_misclassified), "wrong": float(errors.wrong)}
        budgets |= {ERROR_OVER_BOUND: 1.0}
        if name == "critical":
            values[OTHER_SIGNAL], budgets[OTHER_SIGNAL] = float(findings.tir != catalogue.tir), 0.0
        text, worst_ray = f"{version}; total internal reflection: {findings.tir}", {"worst": errors.replay}
        made.append(Row(NAME, title, name, "f64", values, budgets, reason=text, replay=worst_ray))
    assert answers.n_ratio is not None
    ratio_of = dict(zip(answers.ids.tolist(), answers.n_ratio.tolist(), strict=True))
    used = np.array([ratio_of.get(id_, np.nan) for id_ in rays.ids.tolist()])  # NaN if unanswered
    wavelength, pair = header.columns(rays.header, rays.ids).T
    difference = np.abs(used / rays.rays.k - 1)
    for i, glass in enumerate(catalogue.glasses):
        of_glass = np.flatnonzero(pair // 2 == i)
        worst = of_glass[np.argmax(difference[of_glass])]  # argmax returns the first NaN, if any
        off, replay = float(difference[worst]), {"wavelength": float(wavelength[worst]), "glass": glass}
        row = functools.partial(Row, NAME, title, glass, "f64", replay=replay)
        other = catalogue.others.get(glass)
        if other is None:
            made.append(row({INDEX_OFF: off}, {INDEX_OFF: limits.CATALOG_FORMULA}, reason=version))
            continue
        factor = off_recorded(off, other.recorded, other.recorded)
        values = {INDEX_OFF: off, RECORDED: other.recorded, OFF_RECORDED: factor}
        budgets, goals = {OFF_RECORDED: limits.OTHER_INDEX}, {INDEX_OFF: header.SAME}
        made.append(row(values, budgets, goals, f"{version}; {other.cause}"))
    return made


STUDY = Study(NAME, "Glasses by others", about(__doc__), TERMS, tasks, again=repeated.by_tasks(tasks))
