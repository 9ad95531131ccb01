"""Samplers: does an image by a stratified sampler of Mitsuba have the expected image of `independent`?

Mitsuba's stratified samplers permute the strata of each dimension by seeds with constant differences. If numbers of two
dimensions are dependent, all renders of a scene by `path` have the same bias. `refract_path` takes only the camera's
numbers from the sampler: here the position in the pixel.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np

from mi_refract.rendering.render_settings import SAMPLERS
from mi_refract.report.row import Row
from validation.run.context import SCENES, Context
from validation.run.metrics import DETECTABLE_IMAGE, WELCH_ALARMS
from validation.run.render_methods import METHODS, OURS, Method, camera, welch_values_with_whole
from validation.run.seeds import current

from .cases import Case, study

NAME, SEED = "samplers", 2051
BIAS = "bias of the image"
TERMS = {
    BIAS: "relative difference of the whole image's mean from that by `independent`",
    WELCH_ALARMS: "tiles and channels, and the whole image, that differ from those by `independent`; no budget for "
    "`path`, which has Mitsuba's numbers",
    DETECTABLE_IMAGE: "relative difference of the whole image's mean that is detected with a probability of 99 %",
}
INDEPENDENT, STRATIFIED = "independent", tuple(name for name in SAMPLERS if name != "independent")
COMPARED = METHODS[1], METHODS[2]  # without splitting, where `refract_path` always has numbers of its own
SCENE, RESOLUTION, SPP, TILE = "balls", 96, 16, 16  # of the samplers, only `orthogonal` rounds 16, to 25
RENDERS = {"quick": 48, "standard": 400, "full": 2000}


def cases(context: Context) -> Iterator[Case]:
    """Yield one case per integrator."""
    renders = RENDERS[context.profile.name]
    for method in COMPARED:
        work = functools.partial(rows, context.variant, method, renders)
        yield Case(method.name, context.variant, work)


def rows(variant: str, method: Method, renders: int) -> list[Row]:
    """Return one row per stratified sampler."""
    seeds = np.random.default_rng(current(SEED)).integers(2**31, size=(2, renders))

    def images(sampler: str, seeds: np.ndarray) -> np.ndarray:
        render = camera(SCENES / f"{SCENE}.xml", method, RESOLUTION, sampler=sampler, spp=SPP)
        return np.stack([render(SPP, seed=int(seed))[0] for seed in seeds])

    reference, table = images(INDEPENDENT, seeds[0]), list[Row]()
    for sampler in STRATIFIED:
        test = images(sampler, seeds[1])
        values = welch_values_with_whole(reference, test, TILE) | {BIAS: float(test.mean() / reference.mean() - 1)}
        budgets = {WELCH_ALARMS: 0.0} if method.integrator == OURS else {}
        replay = {"scene": SCENE, "resolution": RESOLUTION, "spp": SPP, "renders": renders, "seed": current(SEED)}
        table.append(Row(NAME, method.name, sampler, variant, values, budgets, replay=replay))
    return table


STUDY = study(NAME, "Samplers", __doc__, TERMS, cases)
