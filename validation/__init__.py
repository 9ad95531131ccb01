"""The validation: studies that compare mi_refract and Mitsuba's `dielectric` with certified answers.

In: a profile, which sets how much is measured, and names of studies. Out: rows (`mi_refract.report.row.Row`), and from
them `rows.json`, `junit.xml` and `report.html`. To run it: `python -m validation --help`, and README.md here.

Each folder holds the studies of one name on the command line. `run/` holds what all studies use, `reference/` holds
answers that share no code with the package.
"""

__all__ = ["limits", "runner", "study", "tables"]
