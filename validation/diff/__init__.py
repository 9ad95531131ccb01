"""Which defects does each method of image comparison see, what are its false alarms, and how long does it take?

In: renders of two scenes, with and without planted defects. Out: rows with the share of trials in which each defect was
seen, false alarms, times and sizes.
"""

__all__ = ["planted_defects", "times", "visible_changes", "welch_nulls"]
