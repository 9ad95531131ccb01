"""Other renderers and libraries that really run, each in a process and an environment of its own.

In: rays as CSV, or a plain scene. Out: directions, or images. What runs there is a script of scripts/ that imports
nothing of this project; a script that cannot run on this machine says why in a line on stderr and exits with 77.
"""

from .system import SYSTEMS, System

__all__ = ["SYSTEMS", "System", "command", "environments", "glass_catalogues", "image_renderers"]
