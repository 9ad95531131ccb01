"""What commands do with inputs that are garbage, when they are killed, and what tests do when our code is mutated.

In: seeds and numbers of inputs. Out: rows; every finding names the seed and the index that make the input again.
"""

__all__ = ["code_mutants", "killed_commands", "mutated_inputs"]
