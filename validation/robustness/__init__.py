"""What tests do when our code is mutated. Garbage inputs and killed commands are tests (`tests/robustness`).

In: a seed and a number of mutants. Out: rows, which name each mutant that no test notices.
"""

__all__ = ["code_mutants"]
