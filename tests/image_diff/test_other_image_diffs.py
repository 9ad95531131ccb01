"""The documented settings for users of other image diffs give the verdicts of these programs for each image."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from support.diff_images import save
from support.readme import DOCS

from mi_refract.image_diff import methods
from mi_refract.image_diff.comparison import Verdict
from mi_refract.io.image_file import Image

PAGE = DOCS / "how-to" / "coming-from-other-image-diffs.md"
LIMITS = {"black–white": (1, 1, 1), "red only": (1, 0, 0), "green only": (0, 1, 0), "blue only": (0, 0, 1)}
LIMITS |= {"red one way, green and blue the other": (1, -1, -1)}

# Images ---------------------------------------------------------------------------------------------------------------

Y, X = np.mgrid[:96, :128]
PLAIN = np.stack([40 + X, 60 + Y, 0 * X + 128], -1)
WINDOW = (np.s_[30:60], np.s_[40:70])


def changed(pixels, where=np.s_[:, :]):
    """The plain image with other pixels in a window, as 8-bit codes."""
    image = PLAIN.copy()
    image[where] = np.clip(np.broadcast_to(pixels, PLAIN.shape)[where], 0, 255)
    return image


NOISE = np.random.default_rng(1).integers(-3, 4, PLAIN.shape)
CASES = {
    "identical": PLAIN,
    "noise": PLAIN + NOISE,
    "one code": PLAIN + 1,
    "brighter": PLAIN + 8,
    "much brighter": PLAIN + 60,
    "darker": PLAIN - 60,
    "one pixel": changed(PLAIN + 90, np.s_[50, 50]),
    "three pixels": changed(PLAIN + 110, np.s_[50, 50:53]),
    "a line": changed(PLAIN + 110, np.s_[50, 10:60]),
    "two lines": changed(PLAIN + 110, np.s_[50:52, 5:115]),
    "a box": changed((200, 40, 40), WINDOW),
    "a faint box": changed(PLAIN + 12, WINDOW),
    "other colours": PLAIN[..., ::-1],
    "moved": np.roll(changed((200, 40, 40), WINDOW), 9, 1),
    "black": PLAIN * 0,
}

# Criteria of the programs, from their documentation -------------------------------------------------------------------

YIQ = np.array(
    [[0.29889531, 0.58662247, 0.11448223], [0.59597799, -0.2741761, -0.32180189], [0.21147017, -0.52261711, 0.31114694]]
)


def yiq(a, b):
    """The metric of pixelmatch up to version 7 and of odiff, for codes; 35215 is its largest value."""
    return (np.square((a - b) @ YIQ.T) * (0.5053, 0.299, 0.1957)).sum(-1)


def beyond(a, b, threshold):
    """The number of pixels that pixelmatch counts, with `includeAA`."""
    return int((yiq(a, b) > 35215 * threshold**2).sum())


def idiff(a, b):
    """Whether `idiff -fail 0.004 -failpercent 1 -hardfail 0.5` passes, possibly with warnings."""
    one, two = (oiio.ImageBuf((x / 255).astype(np.float32)) for x in (a, b))
    counts = oiio.ImageBufAlgo.compare(one, two, 0.004, 0.0)
    return counts.nfail == 0 or (counts.nfail <= 0.01 * a[..., 0].size and counts.maxerror <= 0.5)


def flip(a, b):
    """Whether the mean of FLIP's error map, by OpenImageIO, is at most 0.02."""
    codes = [x / 255 for x in (a, b)]
    linear = [np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32) for x in codes]
    error = oiio.ImageBufAlgo.FLIP_diff(*map(oiio.ImageBuf, linear), 0, 2.0, 0.18, 67.02).get_pixels()
    return error[..., 0].mean() <= 0.02


PROGRAMS = {
    "idiff": [idiff],
    "pixelmatch": [lambda a, b: beyond(a, b, 0.1) <= 0.001 * a[..., 0].size],
    "odiff": [lambda a, b: beyond(a, b, 0.1) == 0],
    "Playwright": [lambda a, b: beyond(a, b, 0.2) <= 0.01 * a[..., 0].size, lambda a, b: beyond(a, b, 0.2) <= 100],
    "NVIDIA FLIP": [flip],
}


def sections():
    """The text of each section of the page, and the commands in it, by its title."""
    by_title = {}
    for section in PAGE.read_text("utf-8").split("\n## ")[1:]:
        title, _, text = section.partition("\n")
        by_title[title] = text, re.findall("^mi-refract diff references/ new/ (.+)$", text, re.MULTILINE)
    return by_title


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The plain image as every reference, and CASES as new images."""
    root = tmp_path_factory.mktemp("images")
    for name, pixels in CASES.items():
        for side, codes in (("references", PLAIN), ("new", pixels)):
            path = root / side / f"{name}.png"
            path.parent.mkdir(exist_ok=True)
            save(path, codes.clip(0, 255).astype(np.uint8), "uint8")
    return root / "references", root / "new"


# Verdicts -------------------------------------------------------------------------------------------------------------


def test_the_documentation_has_the_tested_programs():
    documented = {title: len(commands) for title, (_, commands) in sections().items()}
    assert documented == {title: len(criteria) for title, criteria in PROGRAMS.items()}


@pytest.mark.parametrize(
    ("program", "number"), [(name, i) for name, criteria in PROGRAMS.items() for i in range(len(criteria))]
)
def test_documented_settings_give_the_verdicts_of_the_programs(run, folders, tmp_path, program, number):
    words = sections()[program][1][number].split()
    assert run("diff", *folders, *words, "--json", tmp_path / "out.json")[::2] == (1, "")
    results = json.loads((tmp_path / "out.json").read_text())["results"]
    statuses = {Path(result["name"]).stem: result["status"] for result in results}
    passes = {name: PROGRAMS[program][number](PLAIN, pixels.clip(0, 255)) for name, pixels in CASES.items()}
    assert statuses == {name: "equal" if equal else "different" for name, equal in passes.items()}
    assert {"equal", "different"} == {*statuses.values()}


def test_tolerance_counts_every_pixel_that_pixelmatch_counts():
    """With the same threshold as `fail`, no pixel that pixelmatch counts is within it; and the documented limits."""
    rng = np.random.default_rng(4)
    pairs = rng.integers(0, 256, (2, 200_000, 3))
    near = np.clip(pairs[0] + rng.integers(-160, 161, pairs[0].shape), 0, 255)
    for one, two in (pairs, (pairs[0], near)):
        for threshold in (0.05, 0.1, 0.2, 0.5):
            counted = yiq(one, two) > 35215 * threshold**2
            assert counted.any() and (np.abs(one - two).max(-1)[counted] > 255 * threshold).all()
    lines = re.findall(r"^\|.*\|$", sections()["pixelmatch"][0], re.M)
    header, _, cells = (line.strip("| ").split(" | ")[1:] for line in lines)
    limits = [np.sqrt(35215 / yiq(np.array(change), np.zeros(3))) / 255 for change in LIMITS.values()]
    assert header == list(LIMITS)
    assert [float(cell) for cell in cells] == pytest.approx(limits, abs=0.006)


@pytest.mark.parametrize(
    ("option", "name"), [("mean", "mean FLIP error"), ("percentile_99", "99th percentile of the FLIP")]
)
def test_an_exceeded_bound_of_flip_is_named_first(option, name):
    one, two = (Image(Path("a.png"), np.float32(x) / 255, tuple("RGB"), stored="uint8") for x in (PLAIN, PLAIN + 60))
    result = methods.compare("flip", one, two, local=9.0, patch=9.0, one_way=900.0, **{option: 0.1})
    assert result.verdict is Verdict.DIFFERENT and result.reason.startswith(name)
    assert f" > {option} = 0.1; local FLIP error" in result.reason
    assert methods.compare("flip", one, two, local=9.0, patch=9.0, one_way=900.0, **{option: 0.9}).is_equal
