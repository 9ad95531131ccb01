"""Export of Mitsuba scenes to other renderers: every renderer gets the same triangles, materials and camera.

In: a Mitsuba XML file of glass, diffuse surfaces and lights. Out: a folder with the scene in another renderer's format,
and a README.txt with the command that renders it. The command is `mi-refract scene export`; see README.md.
"""

__all__ = ["from_mitsuba", "plain_scene", "targets"]
