"""Names of metrics that several studies or generated tables use.

A table with a wrong name fails at import, not after the run.
"""

from mi_refract.accuracy import BUDGETS

# Directions, per ray: names of the judge.
ERROR_OVER_BOUND, MISCLASSIFIED_FAR = BUDGETS
MISCLASSIFIED = "TIR misclassified"
WORST_CHORD = "worst chord"
WORST_IN_U = "worst / u"
WORST_ANGLE = "worst rad"
ROUNDINGS = 1.0, 2.0**53  # meaningful range of an error in u: from one rounding to a double without a right digit
# Times
TIME_OVER_COPY = "time / copy"
TIME_OVER_PLAIN = "time / plain"
TIME_OVER_BUILTIN = "time / built-in"
TIME_OVER_DIELECTRIC = "time / dielectric"
# Paths
WRONG_PATH = "wrong path"
WRONG_PATH_FAR = "wrong path, beyond rounding"
# Images
OFF_EXACT = "off exact"
BUILTIN_OFF_EXACT = "off exact, built-in"
MEANS_DIFFER = "|mean ratio − 1|"
CHANGED_SHARE = "changed share"
WELCH_ALARMS = "Welch alarms"
SMALLEST_P = "smallest p, adjusted"
MEAN_DIFFERENCE = "mean difference"
DETECTABLE = "minimum detectable difference"
DETECTABLE_IMAGE = "detectable difference, image"
EQUAL_TIME = "equal-time MSE"
EQUAL_TIME_CAUSTIC = "equal-time MSE, caustic"
EQUAL_TIME_DEFAULTS = "equal-time MSE / independent"
EQUAL_TIME_HAND = "equal-time MSE / best by hand"
