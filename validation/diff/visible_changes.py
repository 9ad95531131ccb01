"""The bounds of `flip` between changes that nobody sees and changes that a person sees at once.

The images are shapes of random colours, some of them a pixel wide, drawn with 16 samples per pixel and rounded to 8-bit
sRGB. Changes that nobody sees are those of other machines, formats and samplers; changes that a person sees are small
and faint ones of their kind. "error / bound" is the largest of the local FLIP error, the error throughout a patch and
the change one way, each divided by its bound: `flip` calls images equal up to 1. The bounds of FLIP errors lie between
the largest error of unseen changes and the smallest of seen ones, with a margin on both sides; the bound of the change
one way is computed.

The last rows show what `flip` does not detect: by how many of 255 codes a gray square must change, and how far a black
edge on white must move, to be different. They record what the bounds mean; they are not measurements of people.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr

from mi_refract.image_diff import flip
from mi_refract.image_diff.self_test import CONFIDENCE, FALSE_ALARMS, Tally
from mi_refract.io import image_file
from mi_refract.io.image_file import Image, Pixels
from mi_refract.report.row import Row
from validation.run import seeds
from validation.run.context import Context
from validation.study import Study, Task, about

NAME = "visible_changes"
SEED = 2027
TRIALS = {"quick": 20, "standard": 300, "full": 2000}  # none of 300 may be called different: the bound is 0.99 %
SIZE, SHAPES, SAMPLES = 96, 14, 4  # width and height in pixels; shapes; the square root of the samples per pixel
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE]
MEASURED = LOCAL, THROUGHOUT, ONE_WAY = "local FLIP error", "FLIP error throughout a patch", "change one way, in codes"
ERROR = "error / bound"
ALARMS, MISSED, BOUND = "called different", "missed", "bound"
CODES, PIXELS = "codes of 255", "pixels"
SETTING, LIMIT, EDGE = "67 pixels per degree", "limit", "edge"
SQUARES = (1, 2, 3, 4, 8, 16, 32, 64, 128)  # widths of the recorded squares in pixels
GRAY, WIDE = 100, 160  # codes of their background, width of the image in pixels
TERMS = {
    ERROR: "largest for changes that nobody sees, smallest for changes that a person sees",
    LOCAL: "mean in the worst window; median over the trials",
    THROUGHOUT: "the error that all pixels of a patch of 0.24 degrees exceed; median over the trials",
    ONE_WAY: "change of a 3 × 3 square, or the equivalent of a wider one; median over the trials",
    BOUND: f"{CONFIDENCE:.0%} upper bound of the share that is called different, exact binomial (Clopper and Pearson)",
    CODES: "the smallest change of a gray square that is called different; none if even white is not",
    PIXELS: "the smallest shift of a black edge on white that is called different, in quarters of a pixel",
}


Rng = np.random.Generator
Pair = tuple[Image, Image]
Change = Callable[[Rng], Pair]
Shape = tuple[int, float, float, float, float, Pixels]  # kind, x, y, radius, angle, colour in codes
DISK, BOX, BAR = range(3)  # a bar is one pixel wide


# Images --------------------------------------------------------------------------------------------------------


def scene(rng: Rng) -> list[Shape]:
    """Return the random shapes of an image; the first one covers the image."""
    shapes: list[Shape] = [(BOX, SIZE / 2, SIZE / 2, 2.0 * SIZE, 0.0, rng.uniform(0, 255, 3))]
    for _ in range(SHAPES):
        x, y, radius = rng.uniform(0, SIZE), rng.uniform(0, SIZE), 8 * np.exp(rng.normal(0, 0.6))
        shapes.append((int(rng.integers(3)), x, y, radius, rng.uniform(0, np.pi), rng.uniform(0, 255, 3)))
    return shapes


def drawn(shapes: list[Shape], samples: int = SAMPLES, turn: float = 0.0, shift: float = 0.0) -> Pixels:
    """Return the image in codes, from `samples`² samples per pixel on a grid that is rotated and shifted."""
    grid = (np.arange(samples) + 0.5) / samples - 0.5
    dx, dy = (x.ravel() for x in np.meshgrid(grid, grid))
    dx, dy = dx * np.cos(turn) - dy * np.sin(turn) + 0.5 + shift, dx * np.sin(turn) + dy * np.cos(turn) + 0.5
    background, *others = shapes
    codes = np.tile(background[-1], (SIZE, SIZE, samples**2, 1))
    for kind, left, top, radius, angle, colour in others:
        reach = 1.25 * radius + 3  # from its centre: ≥ hypot(1, 0.7) radius, ≥ hypot(radius, 0.5)
        near = tuple(slice(max(0, int(at - reach)), max(0, int(at + reach))) for at in (top, left))
        x, y = COLUMNS[near][..., None] + dx - left, ROWS[near][..., None] + dy - top
        cos, sin = np.cos(angle), np.sin(angle)
        u, v = x * cos + y * sin, y * cos - x * sin
        box = (np.abs(u) < radius) & (np.abs(v) < (0.7 * radius if kind == BOX else 0.5))
        codes[near][u * u + v * v < radius**2 if kind == DISK else box] = colour
    return np.asarray(codes.mean(2))


def shown(codes: Pixels, rounded: bool = True) -> Image:
    """Return codes as an image for a display."""
    codes = np.clip(np.round(codes) if rounded else codes, 0, 255) / 255
    return Image(Path("codes.png"), codes.astype(np.float32), ("R", "G", "B"), stored="uint8")


def light(codes: Pixels) -> Image:
    """Return codes as an HDR image of 6 stops."""
    return Image(Path("light.exr"), np.exp2(codes / 255 * 6 - 3).astype(np.float32), ("R", "G", "B"))


# Changes that nobody sees ------------------------------------------------------------------------------------------


def of_codes(change: Callable[[Rng, Pixels], Pixels], most: float = 255, rounded: bool = True) -> Change:
    """Return a maker of pairs: the codes of a scene, up to `most`, before and after a change."""

    def make(rng: Rng) -> Pair:
        codes = np.clip(drawn(scene(rng)), 0, most)
        return shown(codes, rounded), shown(change(rng, codes), rounded)

    return make


def redrawn(**options: Any) -> Change:
    """Return a maker of pairs: a scene drawn twice, once with options of `drawn`."""

    def make(rng: Rng) -> Pair:
        shapes = scene(rng)
        return shown(drawn(shapes)), shown(drawn(shapes, **options))

    return make


def _half_floats(rng: Rng) -> Pair:
    image = light(drawn(scene(rng)))
    return image, replace(image, pixels=image.pixels.astype(np.float16).astype(np.float32))


def _soft_edge(rng: Rng) -> Pair:
    """Return a blurred black half-plane on white (up to three pixels), and the same moved by half a pixel."""
    angle, width = rng.uniform(0, np.pi), 0.3 * 10 ** rng.uniform(0, 1)
    distance = COLUMNS * np.cos(angle) + ROWS * np.sin(angle) - rng.uniform(0.3, 0.7) * SIZE
    one, two = (shown(255 * ndtr((distance - x) / width)[..., None] * np.ones(3)) for x in (0.0, 0.5))
    return one, two


def _noise(rng: Rng) -> Pair:
    """Return two images with different gray noise in a quarter of the width and height."""
    codes, x, y = somewhere(rng)
    noisy = []
    for _ in range(2):
        noise = rng.normal(0, 25, (SIZE // 4, SIZE // 4, 1))
        noisy.append(codes.copy())
        noisy[-1][int(y) - SIZE // 8 :, int(x) - SIZE // 8 :][: SIZE // 4, : SIZE // 4] += noise
    return shown(noisy[0]), shown(noisy[1])


def _jpeg(rng: Rng, quality: int = 98, subsampling: str = "4:4:4") -> Pair:
    import OpenImageIO as oiio

    image = shown(drawn(scene(rng)))
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "a.jpg")
        buffer = oiio.ImageBuf(image.pixels)
        buffer.specmod().attribute("Compression", f"jpeg:{quality}")
        buffer.specmod().attribute("jpeg:subsampling", subsampling)
        if not buffer.write(path):
            raise OSError(f"{path}: {buffer.geterror()}")
        return image, image_file.read(path)


# Changes that a person sees ----------------------------------------------------------------------------------------


def somewhere(rng: Rng) -> tuple[Pixels, float, float]:
    """Return the codes of a scene, and a position at least 28 pixels from the border."""
    x, y = rng.uniform(28, SIZE - 28, 2)
    return drawn(scene(rng)), x, y


def patched(image: Pixels, x: float, y: float, side: int, colour: Pixels | float) -> Pixels:
    """Return the image with a square of one colour around a position."""
    image = image.copy()
    left, top = int(x) - side // 2, int(y) - side // 2
    image[top : top + side, left : left + side] = colour
    return image


def _recoloured(rng: Rng, blue: bool = False) -> Pair:
    side, gray = int(rng.integers(8, 13)), rng.uniform(20, 100)
    primaries = np.array([0, 0, 1]) if blue else rng.choice([0, 1], 3)
    other = gray + 140 * (primaries if blue or primaries[:2].any() else np.ones(3))
    at = somewhere(rng)
    return shown(patched(*at, side, gray)), shown(patched(*at, side, other))


def _highlight(rng: Rng) -> Pair:
    sigma, height, gray = rng.uniform(3.3, 4.7), rng.uniform(140, 180), rng.uniform(30, 75)
    image, x, y = somewhere(rng)
    plain = patched(image, x, y, 40, gray)
    more = height * np.exp(-((COLUMNS - x) ** 2 + (ROWS - y) ** 2) / (2 * sigma**2))
    return shown(plain + more[..., None]), shown(plain)


def _moved(rng: Rng) -> Pair:
    side, gray = int(rng.integers(8, 17)), rng.uniform(10, 70)
    image, x, y = somewhere(rng)
    plain = patched(image, x, y, 40, gray)
    return shown(patched(plain, x, y, side, gray + 180)), shown(patched(plain, x + 3, y, side, gray + 180))


def _line(rng: Rng) -> Pair:
    contrast = rng.uniform(225, 255)
    image, x, y = somewhere(rng)
    plain = patched(image, x, y, 40, 255 - contrast)
    line = plain.copy()
    line[int(y), int(x) - 10 : int(x) + 10] = 255
    return shown(line), shown(plain)


def _surface(rng: Rng) -> Pair:
    side, more = int(rng.integers(20, 41)), rng.uniform(14, 20)
    gray = rng.uniform(30, 200)
    at = somewhere(rng)
    return shown(patched(*at, side, gray)), shown(patched(*at, side, gray + more))


def _dot(rng: Rng) -> Pair:
    radius, more, gray = rng.uniform(2.3, 3.5), rng.uniform(45, 80), rng.uniform(60, 140)
    image, x, y = somewhere(rng)
    plain = patched(image, x, y, 40, gray)
    cover = np.clip(radius + 0.5 - np.hypot(COLUMNS - int(x), ROWS - int(y)), 0, 1)
    return shown(plain), shown(plain + rng.choice([-1, 1]) * more * cover[..., None])


def _facet(rng: Rng) -> Pair:
    more = rng.uniform(25, 40)
    image, x, y = somewhere(rng)
    inside = np.ones((SIZE, SIZE), bool)
    for angle in rng.uniform(0, 2 * np.pi) + np.array([0, 2, 4]) * np.pi / 3:
        inside &= (COLUMNS - x) * np.cos(angle) + (ROWS - y) * np.sin(angle) < 3.5
    plain = np.clip(image, 0, 215)
    return shown(plain), shown(plain + more * inside[..., None])


def _lit_surface(rng: Rng) -> Pair:
    side = int(rng.integers(20, 41))
    stops, x, y = somewhere(rng)
    codes = float(stops[int(y), int(x)].mean())
    one, two = (light(patched(stops, x, y, side, codes + more)) for more in (0.0, np.log2(1.25) * 255 / 6))
    return one, two


# By kind: a description, a maker of pairs, and whether a person sees the change; None: in some images.
KINDS: dict[str, tuple[str, Change, bool | None]] = {
    "last bits": (
        "relative 2⁻²³",
        of_codes(lambda rng, x: x * (1 + rng.choice([-1, 1], x.shape) * 2.0**-23), rounded=False),
        False,
    ),
    "one code": ("one more of 255 everywhere", of_codes(lambda rng, x: np.round(x) + 1, most=254), False),
    "dithering": (
        "rounded with and without noise of half a code",
        of_codes(lambda rng, x: x + rng.uniform(-0.5, 0.5, x.shape)),
        False,
    ),
    "other antialiasing": ("the 16 samples on a rotated grid", redrawn(turn=0.46), False),
    "less antialiasing": ("4 samples instead of 16", redrawn(samples=2), False),
    "a quarter pixel": ("the camera moved by a quarter pixel", redrawn(shift=0.25), False),
    "JPEG": ("quality 98, without subsampling of the colours", _jpeg, False),
    "JPEG, subsampled": (
        "quality 95, with one colour per 2 × 2 pixels; seen at some saturated lines",
        functools.partial(_jpeg, quality=95, subsampling="4:2:0"),
        None,
    ),
    "half a pixel": (
        "an edge from black to white, blurred by 0.3 to 3 pixels, moved by half a pixel",
        _soft_edge,
        False,
    ),
    "noise": ("noise of 25 codes in a quarter of the width and height, with other seeds", _noise, False),
    "half floats": ("an HDR image of 6 stops, rounded to 11 bits", _half_floats, False),
    "no antialiasing": ("1 sample instead of 16; seen in some images", redrawn(samples=1), None),
    "colour of an object": (
        "A box of 0.12 to 0.18 degrees with 140 codes more of red or green, alone or with other primaries.",
        _recoloured,
        True,
    ),
    "highlight": (
        "A missing highlight on dark gray, with a standard deviation of 0.05 to 0.07 degrees and 140 to 180 codes.",
        _highlight,
        True,
    ),
    "moved object": ("A box of 0.12 to 0.24 degrees and a contrast of 180 codes, by three pixels.", _moved, True),
    "line": ("A missing line of 1 pixel by 0.3 degrees, with a contrast of 225 to 255 codes.", _line, True),
    "dot": ("An additional dot, 5 to 7 pixels wide, with a contrast of 45 to 80 codes of gray.", _dot, True),
    "facet": ("A triangle with sides of 12 pixels, 25 to 40 codes brighter, among shapes.", _facet, True),
    "brighter surface": ("A surface of 0.3 to 0.6 degrees, 14 to 20 codes brighter.", _surface, True),
    "light on a surface": ("HDR: a surface of 0.3 to 0.6 degrees with a quarter more light.", _lit_surface, True),
    "blue of an object": (
        "A box of 0.12 to 0.18 degrees with 140 codes more of blue only, for which the eye has the least acuity.",
        functools.partial(_recoloured, blue=True),
        None,
    ),
}
CASES = {False: "not seen", True: "seen", None: "seen in part"}


# Judged --------------------------------------------------------------------------------------------------------


def tasks(context: Context) -> list[Task]:
    """Return one task per kind of change, so that an interrupted run keeps finished ones, and one for the limits."""
    kinds = [Task(f"{NAME}: {name}", functools.partial(kind_rows, context, (name,))) for name in KINDS]
    return [*kinds, Task(f"{NAME}, limits", limit_rows)]


def kind_rows(context: Context, names: Iterable[str] = tuple(KINDS)) -> list[Row]:
    """Return the rows of these kinds, with as many pairs as the profile asks for."""
    return [kind_row(name, TRIALS[context.profile.name]) for name in names]


def errors(pair: Pair) -> tuple[float, ...]:
    """Return local FLIP error, error throughout a patch, change one way, and the largest ratio to their bounds."""
    metrics = {metric.name: metric for metric in flip.flip(*pair).metrics if metric.name in MEASURED}
    values = [metrics[name].value if name in metrics else 0.0 for name in MEASURED]  # HDR has no change one way
    return *values, float(np.max([metric.value / (metric.bound or np.nan) for metric in metrics.values()]))


def kind_row(name: str, count: int) -> Row:
    """Return the row of `flip`'s errors in pairs of one kind."""
    text, make, due = KINDS[name]
    trial_seeds = np.random.SeedSequence((seeds.current(SEED), list(KINDS).index(name))).spawn(count)
    *measured, error = np.array([errors(make(np.random.default_rng(seed))) for seed in trial_seeds]).T
    different = int((error > 1 if due else ~(error <= 1)).sum())  # NaN fails either way
    values = {name: float(np.median(x)) for name, x in zip(MEASURED, measured, strict=True)}
    values[ALARMS] = different / count
    budgets: dict[str, float] = {}
    if due:
        values |= {ERROR: float(error.min()), MISSED: float(count - different)}
        budgets = {MISSED: 0.0}
    else:
        values |= {ERROR: float(error.max()), BOUND: Tally(seen=different, trials=count).bound}
    if due is False:
        budgets = {ALARMS: FALSE_ALARMS} | ({BOUND: FALSE_ALARMS} if count >= TRIALS["standard"] else {})
    replay = {"seed": seeds.current(SEED), "trials": count, "size": SIZE}
    return Row(NAME, name, CASES[due], SETTING, values, budgets, reason=text, replay=replay)


def limit_rows() -> list[Row]:
    """Return rows of the smallest changes that are called different: of gray squares by width, and of an edge."""
    plain, white = np.full((WIDE, WIDE, 3), float(GRAY)), (BOX, SIZE / 2, SIZE / 2, 4.0 * SIZE, 0.0, np.full(3, 255.0))

    def square(side: int, codes: int) -> Pair:
        return shown(plain), shown(patched(plain, WIDE / 2, WIDE / 2, side, GRAY + codes))

    def edge(quarters: int) -> Pair:
        """Return a moved black half-plane on white, at the angle with the largest error of all tried angles."""
        positions = (SIZE / 2 - 2 * SIZE + x for x in (0.0, quarters / 4))
        before, after = (shown(drawn([white, (BOX, x, SIZE / 2, 2.0 * SIZE, 0.4, np.zeros(3))])) for x in positions)
        return before, after

    def smallest(make: Callable[[int], Pair], most: int) -> float:
        """Return the smallest number up to `most` for which the pair is different; NaN for none."""
        low, high = 0, most + 1
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if errors(make(middle))[-1] > 1 else (middle, high)
        return float(high) if high <= most else float("nan")

    codes = {side: {CODES: smallest(functools.partial(square, side), 155)} for side in SQUARES}
    rows = [Row(NAME, f"square of {side} pixels", LIMIT, SETTING, values) for side, values in codes.items()]
    return [*rows, Row(NAME, EDGE, LIMIT, SETTING, {PIXELS: smallest(edge, 40) / 4})]


STUDY = Study(
    NAME,
    "Image comparison, visible changes",
    about(__doc__),
    TERMS,
    tasks,
    again=kind_rows,
    records=(EDGE, *(f"square of {side} pixels" for side in SQUARES)),
)
