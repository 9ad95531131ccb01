"""Every budget and every goal of the studies, each with its reason.

A broken budget fails the run. A goal is for times, which a busy machine makes longer: a missed goal is shown and fails
nothing. u is the unit roundoff, 2⁻²⁴ or 2⁻⁵³. Where a limit depends on the ray, on the number of layers or on the
scene, the study computes it from the factor or the probability given here. The a-priori bounds of the formulas are in
`mi_refract.formulas.bounds`, the limits of the planted image defects in `mi_refract.image_diff.self_test`.
"""

from __future__ import annotations

import math

from mi_refract.formulas import bounds
from validation.run.metrics import EQUAL_TIME, EQUAL_TIME_CAUSTIC, EQUAL_TIME_DEFAULTS, EQUAL_TIME_HAND


class Limit(float):
    """An upper bound that knows the reason for it."""

    reason: str


def limit(value: float, reason: str) -> float:
    """The bound `value` as a `Limit`; `reason` says where it comes from."""
    found = Limit(value)
    found.reason = reason
    return found


# Directions ----------------------------------------------------------------------------------------------------

SLACK = limit(4.0, "a constant of an a-priori bound that could be four times smaller has become loose")
SLACK_FROM_RAYS = limit(50_000, "rays per regime: fewer need not come near a bound, so a loose one is no defect there")
SCREEN_OFF = limit(0.01, "u: extended precision, which compares with the certified answer, costs as much")
COPY_TIME = limit(1 / 0.9, "over the time of a copy: nine tenths of the throughput that memory allows")

# Indices of glasses
PRINTED_INDEX = limit(
    5e-6 + 1e-6, "half a unit of the fifth decimal, and 1e-6 for coefficients that are rounded as well"
)
INDEX_ROUNDING = limit(16.0, "u: a sum of at most five terms of one sign but for one, three roundings each, and a root")
# Angles add up 8 u of each direction, and the deviation is stationary: a ray that is off by x turns by O(x²).
PRISM_ANGLE = limit(
    64 * 2.0**-53, "radians: two boundaries, 8u each and the condition 1/cos θ below 2; sines of the expected"
)
# A direction that is off by ε moves the next incidence by up to 2ε, and so on: 8u (1 + 3 + 5 + 7), 2u each for points.
BOW_ANGLE = limit(160 * 2.0**-53, "radians: four boundaries of 8u, each turned on by those after it, and their points")
FOCAL_DISTANCE = limit(5.4e-10, "relative: (h/R)² at h = 1e-3 and the steepest R = 43; aberration is tenths of that")
FURNACE_CHANNEL = limit(3e-3, "relative: a colour of the furnace that would be seen, in each channel")
PANE = limit(1e-3, "one ray in 500 may pass between two faces, beside the edges of a pane")
ABSORPTION_SEEN = limit(0.01, "relative: a difference of an image's mean from `volpath` that must be seen")
SLAB_ABSORPTION = limit(2e-6, "relative: σ d up to 8 in float32, with a way that is off by 2u: 16u and the exponential")
DISPERSION_TIME = limit(1.25, "over the same scene with the index of the d line, with as many samples")
ABSORPTION_TIME = limit(1.5, "over the same scene without absorption: one exponential a colour and leg")
CATALOG_FORMULA = limit(16 * 2.0**-53, "relative: a sum of nine terms, each with a power of λ, and a root; twice")

# BSDF samples, float32 against the built-in's own
SAMPLE_FLIPS = limit(1e-6, "probability of more flips than allowed: a random number within rounding of the reflectance")
SAMPLE_ETA = limit(2e-7, "absolute: one rounding of a ratio up to 1.5, and one of its reciprocal")
SAMPLE_P99 = limit(4e-6, "absolute: a few roundings, for 99 rays of 100")
SAMPLE_MUELLER = limit(6, "radicand errors: one on either side of the boundary, in three factors of the weight")

# Stability -----------------------------------------------------------------------------------------------------

# Where ln cos θ changes by x to first order, cos²θ changes by 2x of itself, and |1 − √(1 ± 2x)| ≤ 2x/(1 + √(1 − 2x)).
# A form at the rounding limit is off by 1.005u a step, where a length has left 1, and by cos θ u/2 ≤ 0.02u for the
# rounded k that scales the tangent: x ≤ 1.025 condition · u. That is a cosine off by 2 condition · u at most while
# √(1 − 2x) ≥ 0.025, so while condition · u ≤ 0.487.
MIRAGE = limit(2.0, "error of the cosine over condition · u, as long as condition · u ≤ FIRST_ORDER")
FIRST_ORDER = limit(0.487, "condition · u up to which the bound of first order holds")
LIGHT_PIPE = limit(
    1.0, "each total internal reflection keeps the accumulated error and adds at most u: only signs change"
)
SYSTEM = limit(1.0, "the condition counts u for every rounding; inputs take √3/2 of it, a form at the limit 0.8724")
PRINT = limit(1.0, "what printing rounds to: 11 surfaces of 20u each, u = 2⁻⁵³, are far below CODE V's digits")

POWER = limit(4.0, "u, relative, of R and of 1 − R: the forms promise 3.12u of R and 2u of T")
POWER_SUM = limit(4.0, "u, of R + T − 1: R · 4u + T · 4u")
AMPLITUDE = limit(8.0, "u, relative, of r_s, r_p and the phase's point of the unit circle")
# Of the larger term of a float32 radicand: the promoted form's error. The compensated one's is less, as κ of a float32
# k up to 2²³ is a pair exactly.
RADICAND = limit(10 * 2.0**-53, "of the larger term of a float32 radicand: the error of the promoted form")
RECIPROCITY = limit(3.0, "u, of T there over T back: two roundings of T and that of 1/k, which T feels once at most")
DIFFUSE = limit(12.5, "u: two cosines of a node, k and κ move R by 2.12u each, next to the 4u of R itself")
WHITE_FURNACE = limit(2.0**-23, "an ulp of 1: the weights of both lobes add up to R + T")
IN_AND_OUT = limit(6.0, "u: k² and 1/k², each with k rounded and squared, 3u")
INDEX_SQUARED = limit(3.0, "u: k rounded and squared")

# Over condition · u of a form at the rounding limit; derived in `stability.derivatives.condition_of`.
DERIVATIVE = limit(
    29.0, "error over condition · u: every product of the differentiated form rounded, each at its worst"
)
ETENDUE = limit(
    41.0, "relative, over condition · u, the condition with 1/12 cosθi: both derivatives, and both directions"
)
ROUNDED_DERIVATIVE = limit(1.01, "error over condition · u of what is computed in float64 and rounded once to float32")
ROUNDED_ETENDUE = limit(3.8, "relative, over condition · u: two vectors rounded, 2, and two directions off unit, √3")
REFLECTANCE = {
    "float32": limit(
        10.5, "of the sum of magnitudes S: the rounded cosine 8.2, its derivative, the result; float64 0.3"
    ),
    "float64": limit(50.0, "of the sum of magnitudes S: 48.2 roundings of cosine, powers, products and quotient"),
}

PATH_BOUNDARY = limit(2.0**-24, "of the direction, (2 m + 1) times after m boundaries: the cosine is rounded twice")
OFF_EXACT = limit(1.0, "of the built-in's pixels: where the two images differ, `refract` is the one that is right")
FLIPPED = limit(1e-3, "of the pixels: a last bit changes the choice between reflection and refraction there")

# Renders -------------------------------------------------------------------------------------------------------

MEANS = limit(1e-4, "relative, of the means of two images of the same random numbers")
CHANGED = limit(1e-3, "of the pixels, same seeds: lobe decisions that a last bit flips")
WELCH_ERROR = limit(1e-3, "probability of any alarm in an image of equal renders, after Šidák")
WELCH_MARGIN = limit(1e-5, "relative: means of float32 images that differ by less are equal")
RENDER_TIME = limit(1.0, "over the built-in's time: `refract` is not slower")

FIRST_IMAGE = {
    64: limit(0.6, "of the built-in's first image of so many glasses: one callable for all of them"),
    1000: limit(0.15, "of the built-in's first image of so many glasses: one callable for all of them"),
}
EDIT = limit(
    0.2, "of the built-in's image after an edit: the index is not a literal in the kernel, so nothing is compiled"
)
FROZEN = limit(1e-5, "of a pixel: the order in which samples are added up")

STOPPED_WRONGLY = limit(1e-3, "probability of so many renders with a larger error than they ended by, if each has 5 %")
PASSES_TIME = limit(1.03, "over one call of `mi.render`: each pass is traced again, and its samples are read again")

# Efficiency ----------------------------------------------------------------------------------------------------

ONLY_GLASS_TIME = limit(0.8, "of the built-in's time: `refract_path` leaves emitter sampling out where all is glass")
ONLY_GLASS = {
    EQUAL_TIME: limit(0.4, "of the built-in's with the same sampler: both lobes of the first boundaries"),
    EQUAL_TIME_DEFAULTS: limit(0.12, "of the built-in's defaults: stratification comes on top"),
}
MIXED = {EQUAL_TIME: limit(0.8, "of the built-in's with the same sampler, where surfaces scatter, too")}
CAUSTICS = {
    EQUAL_TIME: limit(0.4, "of the built-in's with the same sampler, of lamps that are small"),
    EQUAL_TIME_CAUSTIC: limit(0.05, "of the built-in's, where the caustic is seen: paths hardly ever meet such a lamp"),
}
CHOSEN = {
    EQUAL_TIME_HAND: limit(1.1, "of the best settings by hand: what a pilot of 5 % of the render can tell"),
    EQUAL_TIME_DEFAULTS: limit(1.05, "of Mitsuba's defaults: a pilot that gains nothing costs its own 5 %"),
}
CHOSEN_MEDIAN = {EQUAL_TIME_DEFAULTS: limit(0.5, "of Mitsuba's defaults, in the median of the scenes")}
PILOT_SHARE = limit(0.05, "of the render, but for compilation, and for renders that take less than a second")
CAUSTIC_ENERGY = limit(
    5e-3, "relative: a lost internal reflection at the back of a ball is 1e-3, a lost η² more than 1"
)
CAUSTIC_LEVEL = limit(0.05, "relative: the level, by photons that are counted in neighbourhoods, below facets")
CAUSTIC_NOISE = limit(1.25e-3, "relative standard error of an energy: a quarter of what it may be off")
CAUSTIC_DETECTABLE = limit(0.01, "of the mean over the caustic: with more noise a caustic could be wrong and pass")
NOISE = limit(
    1e-5, "of float32 images: below it independent seeds give the same image, and there is no error to compare"
)
SCALING = {
    ("glasses", 64): {"first image / built-in": FIRST_IMAGE[64], "after an edit / built-in": EDIT},
    ("glasses", 1000): {"first image / built-in": FIRST_IMAGE[1000]},
}
CHANGING = {
    "a new scene for each image": limit(
        0.2, "of the built-in's: recorded were 0.06, three times that with Mitsuba's loading"
    ),
    "an edit among 300 glasses": limit(0.3, "of the built-in's: recorded were 0.13; tracing 300 plugins is the same"),
    "a sweep of 12 indices": limit(0.4, "of the built-in's: recorded were 0.26, for images that take 10 ms"),
}

# Planar --------------------------------------------------------------------------------------------------------

GROWN = limit(1.0, "error over the bound on rounding errors, see `validation/planar/rounding.py`")
PLANAR_EQUAL = limit(1e-9, "float64: of the extent, and in radians")
# Of the ellipse lens: a place, a normal and a direction at either boundary, each rounded once in x and in y.
SPOT = limit(6 * math.sqrt(2), "u, of the focus of the ellipse lens: six roundings, each in x and in y")
PLANAR_TIMES = {
    ("llvm float32", "document 004"): {"µs per path": limit(0.1, "two cores, the lens of the original program")},
    ("llvm float32", "M = 1000000"): {
        "µs per path": limit(1.0, "two cores: ten times the segments take much less than ten times as long")
    },
}

# Image comparison ----------------------------------------------------------------------------------------------

DIFF_SECONDS = {
    "tolerance": limit(0.5, "seconds of a 1080p pair, two cores"),
    "welch": limit(3.0, "seconds of 8 + 8 renders of 1080p, two cores"),
    "page": limit(5.0, "seconds of the page of a 1080p image, two cores"),
    "auto": limit(24.0, "seconds of a folder of 1000 pairs of 256², two cores"),
    "from the shell": limit(0.35, "seconds of a process that compares a pair of 256²: a test suite starts hundreds"),
}
PAGE_MEGABYTES = limit(15.0, "MB: a page that can be sent by mail")
MEMORY_MEGABYTES = limit(1024.0 * 2**20 / 1e6, "MB, 1 GiB: what the smallest machines of a CI have to spare")
NULL_ALARM = limit(1e-7, "probability that chance breaks a bound: 1e-4 in 1000 of them, other seeds included")

# Ground truth --------------------------------------------------------------------------------------------------

BODY = limit(1.0, "error over the sum of the largest effects of every rounding on the way")
STANDARD = limit(1.0, "error of a standard number over its bound, whose terms the study derives")
STANDARD_SEEN = limit(1e-3, "relative: of an index; crown glasses of the table differ by twice that, 1.52 and 1.5168")
INDEX_SEEN = limit(1e-4, "relative: an index off by this must move a ray to its bound, or the bound is no test")
FALSE_ALARM = limit(1e-4, "probability that noise, or a sum of independent roundings, exceeds its bound by chance")
RAINBOW_RESOLVED = limit(0.0145 / 10, "degrees, standard error: INDEX_SEEN moves the rainbow by 0.0145")
# Pixels may move the edge: σ²/4(D − D₀) at 0.1 degrees is 3.5e-4; the parabola carries 1.7 of it to D₀, 6e-4, which
# images without noise show, too.
RAINBOW_BLUR = limit(1e-3, "degrees that pixels may move the edge of the rainbow")

# Robustness ----------------------------------------------------------------------------------------------------

UNEXPLAINED = limit(0.05, "of the mutants of our code: no test detects them, and no explanation is recorded")

# Other renderers -----------------------------------------------------------------------------------------------

RECORDED = limit(3.0, "factor between the worst error and the recorded one: the numbers of those rays were not kept")
LENS_TRACE = limit(1.0, "the bound adds up every rounding at its worst, see `validation/reference/exact_lens.py`")
OTHER_INDEX = limit(
    1.02, "factor between the largest difference of an index and the recorded one, of three digits; the data are locked"
)
TEXTBOOK_BACKWARD = limit(bounds.TEXTBOOK_BACKWARD, "u: derived there, for k up to 2.5")
SUITE_ERROR = limit(1e-4, "probability of any alarm in a pair of equal images")
LINE_DETECTABLE = limit(0.01, "of the image's mean: with more noise a dispersive image could be wrong and pass")

EXPORT_SYSTEMATIC = limit(
    0.01,
    "of the image's mean: half floats err by 2⁻¹¹; a grid of 16 × 16 samples by 1/16 of a pixel's contrast where an "
    "edge crosses it along the grid, in a tenth of the pixels; a resampled sky by less",
)
EXPORT_NOISE = limit(0.02, "of the image's mean: with more noise than this a defect could hide")
EXPORT_SIGMAS = limit(2.0, "RMSE over predicted noise; the mean of squares of 144 pixels is below 4 but once in 10⁶⁰")

# Changes that must not be seen
INVISIBLE_ALARM = limit(1e-6, "probability of any false alarm of a test: 1e-3 in a run of 500 rows with two tests each")
INVISIBLE = limit(0.05, "relative: differences of the mean that each row must be able to see")
INVISIBLE_NOISE = limit(2.0, "numbers that repeat in passes of 4 samples leave 4 times the noise; the ratio has 3 %")

NUMBERS_ALARM = limit(1e-4, "probability of any false alarm of the chi-square tests of random numbers, all counts")

# Neighbours of glass
NEIGHBOUR_ALARM = limit(1e-8, "probability of a false alarm of a test: 5e-5 in a run of 5000 tests")
NEIGHBOUR = limit(0.01, "relative: differences of the mean that each row must be able to see")
# Gradients of images
GRADIENT_ALARM = limit(1e-5, "probability that a row's interval leaves the truth out, all looks: 1e-3 in a run of 100")
GRADIENT = limit(0.05, "relative: the error that a derivative has at most, but by GRADIENT_ALARM")
UNBIASED = limit(1.0, "of the interval, which leaves out the truth by GRADIENT_ALARM")
TRUNCATION = limit(0.02, "relative, of D(h), e = (fh)²/6 at the frequency f: D is off by (fh)⁴/30 = 1.2 e², 5e-4")
STEP = limit(1.2 * TRUNCATION**2, "relative: by what the step of finite differences may move D, see TRUNCATION")
FORWARD_MODE = limit(0.05, "of the standard error: both modes draw the same numbers, and add them in another order")
