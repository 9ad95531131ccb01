"""Test rays for the refraction of any program, and the check of its answers.

In: regimes of rays by name (`mi_refract.regimes`), or a file of rays; then a program's answers, as a file or on stdout.
Out: a file of rays (CSV or .npz); for each regime the errors against certified directions, and the usual mistake that
explains wrong answers; as text, JSON, JUnit XML or an HTML page. The command is `mi-refract rays`; see README.md.

In the order of the data: `ray_set` (`header`), `files`; `check_answers` matches answers with rays and has them judged
(`tir_signal`, `judged_answers`, `diagnosis`); `reports`.
"""

__all__ = ["check_answers", "files", "ray_set", "renderer_file", "reports", "tir_signal"]
