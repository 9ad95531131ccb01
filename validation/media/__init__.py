"""Do dispersion and absorption agree with the data of the materials?

In: the makers' catalogues of glass, closed forms, the certified oracle, and renders with the plugin and the integrator.
Out: rows with errors of indices, directions and images, and their bounds.
"""

__all__ = ["catalogs", "closed_forms", "ray_directions", "renders"]
