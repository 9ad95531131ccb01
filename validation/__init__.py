"""The evidence: studies that measure mi_refract and Mitsuba's `dielectric`, and return rows.

`python -m validation [STUDY …] [--profile quick|full] [--out DIR]` runs them and writes the report.
"""
