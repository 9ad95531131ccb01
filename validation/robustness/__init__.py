"""Do the tests detect mutations of the package's code? Garbage inputs and killed commands are tests: tests/robustness.

In: a seed and a number of mutants. Out: rows, which name each mutant that no test detects.
"""

__all__ = ["code_mutants"]
