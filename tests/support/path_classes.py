"""Scenes that only one class of paths lights, in Heckbert's notation without its L and E: "SD" is L S D E.

Vertices are squares in two rows, alternately above and below, and each row faces the other. A square sees only its two
neighbours on the path: squares of its own row are in its plane, and black walls hide all others. So light must hit
every vertex; paths that hit a vertex twice are longer than `max_depth`.
"""

import mitsuba as mi
from support.glass_scenes import BLACK, PLACE

CLASSES = "D", "SD", "SSD", "SDD", "S", "DS", "SDS", "SDSD"
FROM_LAMPS = tuple(word for word in CLASSES if word[0] == "S" and word[-1] == "D")  # with caustics = lamp
UNSEEN = tuple(word for word in CLASSES if word[0] == "S" == word[-1])  # invisible for lamps of zero size
MIRROR = {"type": "conductor"}
WHITE = {"type": "diffuse", "reflectance": 0.8}
# Two more letters: H, a surface that is half S and half D, and T, a D with a tilted shading normal.
HALVES = {"type": "blendbsdf", "weight": 0.5, "delta": MIRROR, "rest": WHITE}
TILTED = {"type": "normalmap", "normalmap": {"type": "rgb", "value": [0.8, 0.5, 0.9]}, "bsdf": WHITE}
HALF = (0.45, 1.2)  # half the sides of a square
BEYOND = 0.05  # distance of the lamp and the camera behind the planes of the rows
LAMPS = {"area": None, "point": {"type": "point", "intensity": 1.0}, "spot": {"type": "spot", "cutoff_angle": 60.0}}


def max_depth(word):
    """Return the length of the paths of this class."""
    return len(word) + 1


def scene(word, lamp="area", size=8, delta=MIRROR, black=None):
    """Load the scene of a class. `delta`: the BSDF of S. `black`: the index of a vertex that is black."""
    bsdfs = {"S": delta, "D": WHITE, "H": HALVES, "T": TILTED}
    parts = {"sensor": camera(len(word) + 1, size), "lamp": light(lamp)}
    for i, letter in enumerate(word):
        bsdf = BLACK if i == black else bsdfs[letter]
        parts[f"vertex {i}"] = {"type": "rectangle", "to_world": facing(i + 1), "bsdf": bsdf}
        parts[f"wall {i}"] = {"type": "cube", "to_world": wall(i + 1), "bsdf": BLACK}
    return mi.load_dict({"type": "scene"} | parts)


def height(i):
    """Return the height of vertex i's row; the lamp has number 0, the camera the last one."""
    return 1.0 if i % 2 == 0 else 0.0


def outside(i):
    """Return a point behind vertex i."""
    return [float(i), height(i) + (BEYOND if i % 2 == 0 else -BEYOND), 0.0]


def facing(i, place=None):
    """Return the transform of a square at vertex i that faces the other row."""
    turn = 90 if i % 2 == 0 else -90
    return PLACE().translate(place or [i, height(i), 0]).rotate([1, 0, 0], turn).scale([*HALF, 1])


def wall(i):
    """Return a wall from the other row to the middle, which hides the vertices before i from those after i."""
    y = 1.25 if height(i) == 0.0 else -0.25  # lines between other vertices pass the wall at a height of 1/2 to 3/4
    return PLACE().translate([i, y, 0]).scale([0.01, 0.75, 3])


def light(kind):
    """Return the lamp: a square, or a lamp of zero size."""
    if kind == "area":
        return {"type": "rectangle", "to_world": facing(0, outside(0)), "emitter": {"type": "area"}}
    down = PLACE().look_at(outside(0), [1, 0, 0], [0, 0, 1])
    return LAMPS[kind] | {"to_world": down}


def camera(i, size):
    """Return the camera at the end of the path, which only sees the last vertex."""
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    view = PLACE().look_at(outside(i), [i - 1, height(i - 1), 0], [0, 0, 1])
    return {"type": "perspective", "fov": 75, "to_world": view, "film": film, "sampler": {"type": "independent"}}
