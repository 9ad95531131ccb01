"""POV-Ray, a program of the machine. Under the GPL: run, never imported nor passed on."""

from .system import Apt, System

SYSTEM = System("povray", "POV-Ray", "AGPL-3.0-or-later", Apt("povray", ("povray",)), megabytes=60, draws=True)
