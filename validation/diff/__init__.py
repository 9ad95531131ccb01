"""Which defects does each method of image comparison detect, what are its false alarms, and how long does it take?

In: renders of two scenes, with and without planted defects. Out: rows with the share of trials in which each defect was
detected, false alarms, times and sizes.
"""

__all__ = ["planted_defects", "times", "visible_changes", "welch_nulls"]
