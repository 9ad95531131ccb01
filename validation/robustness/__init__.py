"""What commands do with inputs that are garbage, and what is left when they are killed or the disk is full.

In: seeds and numbers of inputs. Out: rows; every finding names the seed and the index that make the input again.
"""

__all__ = ["killed_commands", "mutated_inputs"]
