"""How far are other renderers and libraries off, ray by ray and in images of the same scenes?

In: rays and plain scenes, handed to programs of `renderers/`. Out: rows per system and check, and a matrix of them.
"""

__all__ = ["matrix", "per_ray", "rendered_images"]
