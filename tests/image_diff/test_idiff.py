"""`tolerance` beside OpenImageIO's own `idiff`, on random small images and flags: those installed here.

Debian has one in openimageio-tools, the wheel of OpenImageIO brings another. Without either these tests are skipped.
"""

from __future__ import annotations

import itertools
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from support.diff_images import IDIFF

from mi_refract.image_diff import folders
from mi_refract.image_diff.results import Status
from mi_refract.image_diff.settings import Settings, from_words

FOUND = {"installed": shutil.which("idiff"), "wheel": shutil.which("idiff", path=str(Path(sys.executable).parent))}
PAIRS = {"installed": 36, "wheel": 108}  # a process of Debian's takes 0.2 s of CPU, of the wheel's 0.05 s
FORMATS = (("exr", "float"), ("exr", "half"), ("png", "uint8"), ("png", "uint16"))
FORMATS += tuple(("tif", kind) for kind in ("uint8", "uint16", "float"))  # idiff reads all others as float32
THRESHOLDS = (0.0, 1e-6, 1 / 255, 0.004, 0.01, 0.1, 0.25)
FLAGS = {"-fail": 0.8, "-failrelative": 0.2, "-failpercent": 0.85, "-hardfail": 0.3, "-allowfailures": 0.25}
FLAGS |= {"-warn": 0.5, "-warnrelative": 0.2, "-warnpercent": 0.3, "-hardwarn": 0.3}
PASS, WARNING, FAIL = 0, 1, 2


@pytest.fixture(params=FOUND)
def idiff(request):
    """The exit code of a program `idiff` for flags and two files."""
    path = FOUND[request.param]
    if path is None:
        pytest.skip(f"no idiff ({request.param}): on Debian it is in openimageio-tools")

    def run(flags, *files):
        return subprocess.run([path, *flags.split(), *map(str, files)], capture_output=True, timeout=60).returncode

    run.pairs = PAIRS[request.param]
    return run


def write(path, images, kind):
    """A file with one part for each array."""
    specs = []
    for number, pixels in enumerate(images):
        spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
        spec.attribute("oiio:subimagename", str(number))
        specs.append(spec)
    output = oiio.ImageOutput.create(str(path))
    for number, (spec, pixels) in enumerate(zip(specs, images, strict=True)):
        first = tuple(specs) if path.suffix == ".exr" else spec  # OpenEXR wants all headers first
        assert output.open(str(path), spec, "AppendSubimage") if number else output.open(str(path), first)
        assert output.write_image(pixels)
    assert output.close()
    return path


def flags(rng):
    words = ["-a"]
    for flag in (flag for flag, share in FLAGS.items() if rng.random() < share):
        values = [5, 12.5, 25, 100 / 3, 50, 75, 90] if flag.endswith("percent") else THRESHOLDS
        values = THRESHOLDS[:5] if flag in ("-fail", "-warn") else values
        number = rng.integers(1, 5) if flag == "-allowfailures" else float(rng.choice(values))
        words += [flag, str(number)]
    return " ".join(words)


def pair(rng, shape):
    """Two arrays, H × W × C; some values differ, by a threshold, by a little more or less, or by anything."""
    a = rng.random(shape, np.float32) if rng.random() < 0.7 else np.full(shape, rng.choice([0, 0.25, 0.5]), np.float32)
    step = rng.choice([*THRESHOLDS, *THRESHOLDS, rng.random()]) * rng.choice([1, 1, 1, 0.5, 2, 1 + 1e-6, 1 - 1e-6])
    relative = a if rng.random() < 0.3 else np.ones_like(a)
    changed = rng.random(shape) < rng.choice([0.05, 0.15, 0.5, 1], p=[0.3, 0.4, 0.2, 0.1])
    return a, np.where(changed, a + relative * step * rng.choice([-1, 1], shape), a).astype(np.float32)


def ours(words, *files):
    """The exit code that `idiff` would have, by our verdict; that black would pass, too, is nothing to `idiff`."""
    parts, chosen = words.replace("--", "-").split(), dict(IDIFF.values())
    chosen |= {IDIFF[flag][0]: value for flag, value in itertools.pairwise(parts) if flag in IDIFF}
    layer = from_words("tolerance", [f"{option}={value}" for option, value in chosen.items()])
    (found,) = folders.diff(*files, Settings((layer,))).results
    if found.status is Status.DIFFERENT:
        return FAIL, found.reason
    assert found.status is Status.EQUAL or "black" in found.reason
    return (WARNING if found.warning else PASS), found.reason


def test_random_images_and_flags(idiff, tmp_path):
    rng = np.random.default_rng(15)
    codes, wrong = Counter(), []
    for number in range(idiff.pairs):
        suffix, kind = FORMATS[number % len(FORMATS)]
        count = 1 if suffix == "png" or rng.random() < 0.6 else int(rng.integers(2, 4))
        channels = rng.choice([1, 2, 3, 4, 5] if suffix == "exr" else [1, 3])  # an alpha is only multiplied by idiff
        shape = (*rng.integers(1, 9, 2), channels)
        sides = zip(*(pair(rng, shape) for _ in range(count)), strict=True)
        files = [write(tmp_path / f"{side}.{suffix}", images, kind) for side, images in zip("ab", sides, strict=True)]
        words = flags(rng)
        expected, (code, reason) = idiff(words, *files), ours(words, *files)
        codes[expected] += 1
        if code != expected:
            wrong.append((number, f"{suffix} {kind}", words, f"idiff {expected}, here {code}: {reason}"))
    assert wrong == []
    assert min(codes[PASS], codes[WARNING], codes[FAIL]) >= idiff.pairs / 18, codes  # none of them is left out


@pytest.mark.parametrize(
    "words, code",
    [
        ("-fail 0.01", FAIL),
        ("-fail 0.02", PASS),
        ("-fail 0.02 -warn 0.001", PASS),  # idiff asks for warnings only where a pixel fails
        ("-fail 0.02 -hardfail 0.001", PASS),  # and for hardfail
        ("-fail 0.001 -failpercent 10", WARNING),
        ("-fail 0.001 -failpercent 10 -warn 0.02", PASS),
        ("-fail 0.001 -failpercent 10 -warn 0.02 -hardwarn 0.01", WARNING),
        ("-fail 0.001 -failpercent 10 -hardfail 0.01", FAIL),
        ("-fail 0.001 -allowfailures 2 -hardfail 0.01", PASS),
        ("-fail 0.001 -allowfailures 1 -hardfail 0.01", FAIL),
        ("-fail 0.001 -failrelative 0.1", PASS),
        ("", FAIL),
        ("-q -v -abs -scale 2", FAIL),
        ("--fail 0.02 --hardfail .5", PASS),
        ("-fail 0.5 -fail 0.001", FAIL),
    ],
)
def test_each_flag(idiff, tmp_path, words, code):
    """Two pixels of 25 differ by 0.015, one of them in two channels."""
    a = np.full((5, 5, 3), 0.5, np.float32)
    b = a.copy()
    b[1, 2, :2] += 0.015
    b[4, 4, 2] -= 0.015
    files = [write(tmp_path / name, [pixels], "float") for name, pixels in (("a.exr", a), ("b.exr", b))]
    assert (idiff(words, *files), ours(words, *files)[0]) == (code, code)


@pytest.mark.parametrize("suffix", ["exr", "tif"])
def test_only_a_later_part_differs(idiff, tmp_path, suffix):
    a = np.full((4, 4, 3), 0.5, np.float32)
    files = [write(tmp_path / f"{x}.{suffix}", [a, a + x], "float") for x in (0.0, 0.1)]
    assert (idiff("-a -fail 0.01", *files), ours("-fail 0.01", *files)[0]) == (FAIL, FAIL)
    more = write(tmp_path / f"more.{suffix}", [a], "float")
    assert (idiff("-a -fail 0.01", files[0], more), ours("-fail 0.01", files[0], more)[0]) == (FAIL, FAIL)
