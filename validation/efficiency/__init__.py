"""How large is the error of an image after a given time, how does the time grow with the scene, and on how many workers
does it fall?

In: integrators, BSDFs and samplers. Out: rows with errors, times and memory, and curves of them.
"""

__all__ = ["changing_indices", "cluster_scale", "error_against_time", "scaling"]
