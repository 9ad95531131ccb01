"""One module per renderer that a plain scene is written for. Each has `files(plain)`: the export's files by name.

`COMMANDS` is the text that says how to render; `ASSUMPTIONS` says where the renderer's model differs from Mitsuba's.
"""

__all__ = ["cycles", "luxcore", "mitsuba", "obj", "povray", "radiance", "raysect", "scene_json"]
