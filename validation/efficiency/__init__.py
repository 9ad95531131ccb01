"""How large is the error of an image after a given time, and how does the time grow with the scene?

In: integrators, BSDFs and samplers. Out: rows and curves of errors, times and memory.
"""

__all__ = ["caustic_scenes", "caustics", "changing_indices", "chosen_settings", "error_against_time", "scaling"]
