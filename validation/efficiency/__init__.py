"""How much error does an image have after how much time, and how does that time grow with the scene?

In: integrators, BSDFs and samplers. Out: rows with errors, times, memory, and curves of them.
"""

__all__ = ["error_against_time", "scaling"]
