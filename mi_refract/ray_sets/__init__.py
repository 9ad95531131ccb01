"""Test rays for the refraction of any program, and the check of its answers.

Input: regimes of rays by name (`mi_refract.regimes`), or a file of rays; then a program's answers, as a file or from
stdout. Output: a file of rays (CSV or .npz); for each regime the errors against certified directions, and the common
mistake that explains wrong answers; as text, JSON, JUnit XML or an HTML page. The command is `mi-refract rays`; see
README.md.

Modules in the order of the data: `ray_set` (`header`), `files`; `check_answers`, which matches answers with rays and
judges them (`tir_signal`, `judged_answers`, `diagnosis`); `reports`.
"""

__all__ = ["check_answers", "files", "ray_set", "renderer_file", "reports", "tir_signal"]
