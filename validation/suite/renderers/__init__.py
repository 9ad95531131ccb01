"""Other renderers and libraries that really run, each in a process and an environment of its own; see `SYSTEMS`.

What runs there is a script of scripts/ that imports nothing of this project. A script that cannot run on this machine
says why in a line on stderr and exits with 77.
"""

from . import cycles, glsl, luxcore, mitsuba_builtin, optiland, povray, pyglm, radiance, rayoptics, three
from .system import System

SYSTEMS: dict[str, System] = {
    module.SYSTEM.name: module.SYSTEM
    for module in (mitsuba_builtin, pyglm, glsl, rayoptics, optiland, radiance, cycles, luxcore, povray, three)
}
