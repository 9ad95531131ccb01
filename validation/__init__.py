"""The measurements: studies that compare mi_refract and Mitsuba's `dielectric` with certified answers.

In: a profile, which says how much is measured, and the names of studies. Out: rows (`mi_refract.report.row.Row`), and
from them `rows.json`, `junit.xml` and `report.html`. How to run it: `python -m validation --help`, and README.md here.

Each room holds the studies of one name on the command line. `run/` is what all of them use, `reference/` holds answers
that share no code with the package.
"""

__all__ = ["limits", "runner", "study", "tables"]
