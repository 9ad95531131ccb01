"""The formats that a plain scene is written in. Each has a function that returns the export's files by name.

`COMMANDS` is the text that says how to render; `ASSUMPTIONS` says where the renderer's model differs from Mitsuba's.
"""

__all__ = ["luxcore", "mitsuba", "povray", "radiance", "scene_json", "shared_files"]
