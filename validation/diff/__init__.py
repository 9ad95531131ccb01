"""Which defects does each method of image comparison see, how often is it wrong, and what does it cost?

In: renders of two scenes, clean and with planted defects. Out: rows with the share of trials in which each defect was
seen, false alarms, times and sizes.
"""

__all__ = ["planted_defects", "times"]
