"""Is light refracted by its wavelength, and absorbed on its way, as the materials say?

In: the makers' catalogues of glass, closed forms, the certified oracle, and renders through the plugin and the
integrator. Out: rows with errors of indices, of directions and of images, each beside its bound.
"""

__all__ = ["catalogs", "closed_forms", "ray_directions", "renders"]
