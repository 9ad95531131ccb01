"""How large is the error of an image after a given time, and how does the time grow with the scene?

In: integrators, BSDFs and samplers. Out: rows with errors, times and memory, and curves of them.
"""

__all__ = ["caustic_scenes", "caustics", "changing_indices", "chosen_settings", "error_against_time", "scaling"]
