"""All budgets and goals of the studies, each with its reason.

A broken budget fails the run. A missed goal is reported but fails nothing: goals are mostly for times, which grow on a
busy machine. u is the unit roundoff, 2⁻²⁴ or 2⁻⁵³. If a limit depends on the ray, the number of layers or the scene,
the study computes it from the factor or the probability given here. The a-priori bounds of the formulas are in
`mi_refract.formulas.bounds`, the limits of the planted image defects in `mi_refract.image_diff.self_test`.
"""

from __future__ import annotations

import math

from mi_refract.formulas import bounds
from validation.run.metrics import EQUAL_TIME, EQUAL_TIME_CAUSTIC, EQUAL_TIME_DEFAULTS, EQUAL_TIME_HAND


class Limit(float):
    """An upper bound with the reason for its value."""

    reason: str


def limit(value: float, reason: str) -> float:
    """Return the upper bound `value` with `reason`: what it applies to and where it comes from."""
    bound = Limit(value)
    bound.reason = reason
    return bound


# Directions ----------------------------------------------------------------------------------------------------

SLACK = limit(4.0, "an a-priori bound is loose if its constant could be four times smaller")
SLACK_FROM_RAYS = limit(50_000, "rays per regime: fewer rays may all stay far below a tight bound")
SCREEN_OFF = limit(0.01, "u: the rounding error of extended precision in the comparison with the certified answer")
COPY_TIME = limit(1 / 0.9, "over the time of a copy: nine tenths of the throughput that memory allows")

# Indices of glasses
PRINTED_INDEX = limit(
    5e-6 + 1e-6, "half a unit of the fifth decimal, plus 1e-6 because the printed coefficients are rounded too"
)
INDEX_ROUNDING = limit(16.0, "u: a sum of up to five terms with three roundings each, all but one of one sign; a root")
# Each direction adds 8 u to the angle. The deviation is stationary: an input off by x changes it by O(x²).
PRISM_ANGLE = limit(
    64 * 2.0**-53, "radians: two boundaries of 8u each, the condition 1/cos θ below 2, and sines of the expected angle"
)
# A direction that is off by ε changes the next angle of incidence by up to 2ε, and so on: 8u (1 + 3 + 5 + 7), plus 2u
# for each point.
BOW_ANGLE = limit(160 * 2.0**-53, "radians: four boundaries of 8u, amplified by the next ones, and their points")
FOCAL_DISTANCE = limit(5.4e-10, "relative: (h/R)² at h = 1e-3 and the smallest R = 43; aberration is tenths of that")
FURNACE_CHANNEL = limit(3e-3, "relative, in each channel: the deviation from white that must be detected")
# At 100 m two ulp are 1.5e-5 m. A strip of that width on either side of a diagonal, √2 · 1.4 m long, is 3e-5 of a view
# of 1.4 × 1.4 m, and a pane has two faces.
PANE_RAYS = limit(6e-5, "of the rays: so close to the diagonal of a face that they may pass between its two triangles")
PANE = limit(1e-3, "relative, at most; with 64² pixels the chance of lost rays is less, and is the budget")
ABSORPTION_SEEN = limit(0.01, "relative: a difference of an image's mean from `volpath` that must be detected")
SLAB_ABSORPTION = limit(2e-6, "relative: σ d up to 8 in float32, a path length off by 2u: 16u, and the exponential")
DISPERSION_TIME = limit(1.25, "over the same scene with the index of the d line and as many samples")
ABSORPTION_TIME = limit(1.5, "over the same scene without absorption: one exponential per colour and path segment")
CATALOG_FORMULA = limit(16 * 2.0**-53, "relative: two evaluations of a sum of nine terms with powers of λ, and a root")

# BSDF samples, float32 against the built-in's own
SAMPLE_FLIPS = limit(1e-6, "probability of more flips than allowed: random numbers within rounding of the reflectance")
SAMPLE_ETA = limit(2e-7, "absolute: one rounding of a ratio up to 1.5, and one of its reciprocal")
SAMPLE_P99 = limit(4e-6, "absolute: a few roundings, in 99 of 100 rays")
SAMPLE_MUELLER = limit(6, "errors of the radicand: one on each side of the boundary, in three factors of the weight")

# Stability -----------------------------------------------------------------------------------------------------

# If ln cos θ changes by x to first order, cos²θ has the relative change 2x, and |1 − √(1 ± 2x)| ≤ 2x/(1 + √(1 − 2x)).
# A form at the rounding limit has an error of 1.005u per step, since lengths differ from 1, and of cos θ u/2 ≤ 0.02u
# for the rounded k that scales the tangent: x ≤ 1.025 condition · u. The cosine is then off by at most 2 condition · u
# as long as √(1 − 2x) ≥ 0.025, that is for condition · u ≤ 0.487.
MIRAGE = limit(2.0, "error of the cosine over condition · u, as long as condition · u ≤ FIRST_ORDER")
FIRST_ORDER = limit(0.487, "condition · u up to which the bound of first order holds")
LIGHT_PIPE = limit(1.0, "each total reflection keeps the accumulated error and adds at most u: only signs change")
SYSTEM = limit(
    1.0, "the condition counts u per rounding; rounded inputs use √3/2 of it, forms at the rounding limit 0.8724"
)
PRINT = limit(1.0, "over the rounding of the printed digits: 11 surfaces of 20u each, u = 2⁻⁵³, are far below it")

POWER = limit(4.0, "u, relative, of R and of 1 − R: the forms guarantee 3.12u of R and 2u of T")
POWER_SUM = limit(4.0, "u, of R + T − 1: R · 4u + T · 4u")
AMPLITUDE = limit(8.0, "u, relative, of r_s, r_p and exp(iφ) of the phase φ")
# The compensated form's error is smaller, since κ of a float32 k up to 2²³ is exactly a pair.
RADICAND = limit(10 * 2.0**-53, "over the larger term of a float32 radicand: the error of the promoted form")
RECIPROCITY = limit(3.0, "u, of T forward over T backward: two roundings of T, and one of 1/k, at most u")
DIFFUSE = limit(12.5, "u: two cosines of a node, k and κ change R by 2.12u each, in addition to the 4u of R itself")
WHITE_FURNACE = limit(2.0**-23, "an ulp of 1: the weights of both lobes add up to R + T")
IN_AND_OUT = limit(6.0, "u: k² and 1/k², each with k rounded and squared, 3u")
INDEX_SQUARED = limit(3.0, "u: k rounded and squared")

# Over condition · u of a form at the rounding limit; derived in `stability.derivatives.condition_of`.
DERIVATIVE = limit(29.0, "error over condition · u: all products of the differentiated form rounded, at their worst")
ETENDUE = limit(41.0, "relative, over condition · u, with 1/(12 cosθi) added: both derivatives, both directions")
ROUNDED_DERIVATIVE = limit(1.01, "error over condition · u of what is computed in float64 and rounded once to float32")
ROUNDED_ETENDUE = limit(3.8, "relative, over condition · u: two vectors rounded, 2, and two directions off unit, √3")
REFLECTANCE = {
    "float32": limit(10.5, "of the sum of magnitudes S: rounded cosine 8.2, its derivative, the result; float64 0.3"),
    "float64": limit(50.0, "of the sum of magnitudes S: 48.2 roundings of cosine, powers, products and quotient"),
}

PATH_BOUNDARY = limit(2.0**-24, "of the direction, times 2 m + 1 after m boundaries: each rounds the cosine twice")
OFF_EXACT = limit(0.5, "over the built-in's count: `refract` has at most a third of the pixels that only one has wrong")
FLIPPED = limit(1e-3, "of the pixels: a last bit changes the choice between reflection and refraction")

# Renders -------------------------------------------------------------------------------------------------------

MEANS = limit(1e-4, "relative, of the means of two images of the same random numbers")
CHANGED = limit(1e-3, "of the pixels, same seeds: a last bit changes the choice of the lobe")
WELCH_ERROR = limit(1e-3, "probability of any alarm in an image of equal renders, by Šidák's correction")
WELCH_MARGIN = limit(1e-5, "relative: means of float32 images that differ by less count as equal")
RENDER_TIME = limit(1.0, "over the built-in's time: `refract` is not slower")

FIRST_IMAGE = {
    64: limit(0.6, "of the built-in's time for a first image with 64 glasses: all of them share one callable"),
    1000: limit(0.15, "of the built-in's time for a first image with 1000 glasses: all of them share one callable"),
}
EDIT = limit(
    0.2, "of the built-in's time after an edit: the index is not a literal in the kernel, so nothing is compiled again"
)
FROZEN = limit(1e-5, "of a pixel: the order in which samples are summed")

STOPPED_WRONGLY = limit(1e-3, "probability of more renders above the error that they stopped at, if each has below 5 %")
STOPPED_ALIKE = limit(0.95, "share of the renders: half are expected, and all of 20 by chance once in 7000 cases")
PASSES_TIME = limit(1.03, "over one call of `mi.render`: every pass is traced anew and its samples are read back")

# Efficiency ----------------------------------------------------------------------------------------------------

ONLY_GLASS_TIME = limit(0.8, "of the built-in's time: `refract_path` samples no emitters in scenes of glass only")
ONLY_GLASS = {
    EQUAL_TIME: limit(0.4, "over the built-in with the same sampler: both lobes of the first boundaries are followed"),
    EQUAL_TIME_DEFAULTS: limit(0.12, "over the built-in with its defaults: stratification reduces the error further"),
}
MIXED = {EQUAL_TIME: limit(0.8, "over the built-in with the same sampler, in scenes with matt surfaces too")}
CAUSTICS = {
    EQUAL_TIME: limit(0.4, "over the built-in with the same sampler, for small lamps"),
    EQUAL_TIME_CAUSTIC: limit(0.05, "over the built-in, in the caustic: paths from the camera rarely hit small lamps"),
}
CHOSEN = {
    EQUAL_TIME_HAND: limit(1.1, "over the best settings by hand: what a pilot of 5 % of the render can resolve"),
    EQUAL_TIME_DEFAULTS: limit(1.05, "over Mitsuba's defaults: letting a pilot choose costs no more than its own time"),
}
CHOSEN_MEDIAN = {EQUAL_TIME_DEFAULTS: limit(0.5, "over Mitsuba's defaults, in the median of the scenes")}
PILOT_SHARE = limit(0.05, "of the render, without compilation, for renders of at least a second")
CAUSTIC_ENERGY = limit(
    5e-3, "relative: a missing internal reflection at the back of a ball is 1e-3, a missing η² more than 1"
)
CAUSTIC_LEVEL = limit(0.05, "relative: photon density is estimated over neighbourhoods, and facets change the power")
CAUSTIC_NOISE = limit(1.25e-3, "relative standard error of an energy: a quarter of CAUSTIC_ENERGY")
CAUSTIC_DETECTABLE = limit(0.01, "of the mean over the caustic: with more noise a wrong caustic could pass")
NOISE = limit(1e-5, "of float32 images: below it independent seeds give the same image, so there is no error")
SCALING = {
    ("glasses", 64): {"first image / built-in": FIRST_IMAGE[64], "after an edit / built-in": EDIT},
    ("glasses", 1000): {"first image / built-in": FIRST_IMAGE[1000]},
}
CHANGING = {
    "a new scene for each image": limit(
        0.2, "over the built-in: 0.06 was measured, and three times that with Mitsuba's loading"
    ),
    "an edit among 300 glasses": limit(0.3, "over the built-in: 0.13 was measured; both trace 300 plugins"),
    "a sweep of 12 indices": limit(0.4, "over the built-in: 0.26 was measured, on images that take 10 ms"),
}

# Planar --------------------------------------------------------------------------------------------------------

GROWN = limit(1.0, "error over the bound on rounding errors, see `validation/planar/rounding.py`")
PLANAR_EQUAL = limit(1e-9, "float64: relative to the extent, and in radians")
# A point, a normal and a direction at each of two boundaries, each rounded once in x and in y.
SPOT = limit(6 * math.sqrt(2), "u, of the focus of the ellipse lens: six roundings, each in x and in y")
PLANAR_TIMES = {
    ("llvm float32", "document 004"): {"µs per path": limit(0.1, "on two cores, for the lens of the original program")},
    ("llvm float32", "M = 1000000"): {
        "µs per path": limit(1.0, "on two cores: ten times the segments take much less than ten times as long")
    },
}

# Image comparison ----------------------------------------------------------------------------------------------

DIFF_SECONDS = {
    "tolerance": limit(0.5, "seconds for a 1080p pair, on two cores"),
    "welch": limit(3.0, "seconds for 8 + 8 renders of 1080p, on two cores"),
    "page": limit(5.0, "seconds for the HTML page of a 1080p image, on two cores"),
    "auto": limit(24.0, "seconds for a folder of 1000 pairs of 256², on two cores"),
    "from the shell": limit(0.35, "seconds for a process that compares a pair of 256²: a test suite starts hundreds"),
}
PAGE_MEGABYTES = limit(15.0, "MB: an HTML page that can be sent by mail")
MEMORY_MEGABYTES = limit(1024.0 * 2**20 / 1e6, "MB, 1 GiB: the free memory of the smallest CI machines")
NULL_ALARM = limit(1e-7, "probability that chance breaks a bound: 1e-4 for 1000 bounds, other seeds included")

# Ground truth --------------------------------------------------------------------------------------------------

BODY = limit(1.0, "error over the sum of the largest effects of all roundings along the path")
STANDARD = limit(1.0, "error of a standard number over its bound, whose terms the study derives")
STANDARD_SEEN = limit(1e-3, "relative, of an index: crown glasses of 1.52 and 1.5168 in the table differ by twice that")
INDEX_SEEN = limit(1e-4, "relative: an index off by this must move a ray to its bound, or the bound tests nothing")
FALSE_ALARM = limit(1e-4, "probability that noise, or a sum of independent roundings, exceeds its bound by chance")
RAINBOW_RESOLVED = limit(0.0145 / 10, "degrees, standard error: an index off by 1e-4 moves the rainbow by 0.0145")
# Pixels may move the edge: σ²/4(D − D₀) at 0.1 degrees is 3.5e-4. The fitted parabola multiplies this by 1.7 at D₀:
# 6e-4, which images without noise confirm.
RAINBOW_BLUR = limit(1e-3, "degrees by which the size of the pixels may move the edge of the rainbow")

# Robustness ----------------------------------------------------------------------------------------------------

UNEXPLAINED = limit(0.05, "of the mutants of our code: no test detects them, and no explanation is recorded")

# Other renderers -----------------------------------------------------------------------------------------------

RECORDED = limit(3.0, "factor between the worst error and the recorded one: the recorded one is of other rays")
LENS_TRACE = limit(1.0, "the bound adds all roundings at their worst, see `validation/reference/exact_lens.py`")
OTHER_INDEX = limit(
    1.02, "factor between the largest difference of an index and the recorded one (three digits); the data are locked"
)
TEXTBOOK_BACKWARD = limit(bounds.TEXTBOOK_BACKWARD, "u, for k up to 2.5: derived in `mi_refract.formulas.bounds`")
SUITE_ERROR = limit(1e-4, "probability of any alarm in a pair of equal images")
LINE_DETECTABLE = limit(0.01, "of the image's mean: with more noise a wrong dispersive image could pass")

EXPORT_SYSTEMATIC = limit(
    0.01,
    "of the image's mean: half floats are off by 2⁻¹¹; a grid of 16 × 16 samples by 1/16 of a pixel's contrast if an "
    "edge crosses the pixel along the grid, in a tenth of the pixels; a resampled sky by less",
)
EXPORT_NOISE = limit(0.02, "of the image's mean: more noise could hide a defect")
EXPORT_SIGMAS = limit(2.0, "RMSE over noise: in 144 pixels of equal noise the mean square exceeds 4 once in 10⁵² times")

# Changes that must not be visible
INVISIBLE_ALARM = limit(1e-6, "probability of any false alarm of a test: 1e-3 in a run of 500 rows with two tests each")
INVISIBLE = limit(0.05, "relative: a difference of the mean that each row must be able to detect")
INVISIBLE_NOISE = limit(
    2.0, "random numbers repeated in passes of 4 samples give 4 times the noise; the ratio is known to 3 %"
)

NUMBERS_ALARM = limit(1e-4, "probability of any false alarm of the chi-square tests of random numbers, all counts")

# Neighbours of glass
NEIGHBOUR_ALARM = limit(1e-8, "probability of a false alarm of a test: 5e-5 in a run of 5000 tests")
NEIGHBOUR = limit(0.01, "relative: a difference of the mean that each row must be able to detect")
# Gradients of images
GRADIENT_ALARM = limit(1e-5, "probability that a row's interval misses the truth, all looks: 1e-3 in a run of 100 rows")
GRADIENT = limit(0.05, "relative: the largest error of a derivative, exceeded with probability GRADIENT_ALARM")
UNBIASED = limit(1.0, "of the interval, which misses the truth with probability GRADIENT_ALARM")
TRUNCATION = limit(0.02, "relative, of D(h), e = (fh)²/6 at the frequency f: D is off by (fh)⁴/30 = 1.2 e², 5e-4")
STEP = limit(1.2 * TRUNCATION**2, "relative: what the step of finite differences may change D by, see TRUNCATION")
FORWARD_MODE = limit(0.05, "of the standard error: both modes draw the same numbers and sum them in another order")
