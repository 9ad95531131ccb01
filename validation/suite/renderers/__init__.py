"""Other renderers and libraries, each run in its own process and environment.

In: rays as CSV, or a plain scene. Out: directions, or images. Each is run by a script of scripts/, which imports
nothing of this project. A script that cannot run on this machine prints the reason on stderr and exits with 77.
"""

from .system import SYSTEMS, System

__all__ = ["SYSTEMS", "System", "command", "environments", "glass_catalogues", "image_renderers"]
