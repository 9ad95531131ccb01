"""Fixtures for pytest that compare images: `assert_image_equal` and `assert_image_unbiased`.

In the conftest.py of the tests: `pytest_plugins = ["mi_refract.pytest_plugin"]`. It is no entry point, because that
would load Mitsuba, and with it a libLLVM, into every pytest run of the environment, before any conftest.py could choose
one. An image is a file, or an array, H × W × C or H × W. Nothing is ever written, and a reference that does not exist
fails the test.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from mi_refract.image_diff.comparison import Comparison
    from mi_refract.io.image_file import Image as ReadImage

Image = Any  # the path of a file, or what numpy makes an array of
Renderer = Callable[[int], Image]  # of a seed
RUNS = 8
REFERENCE_SEED = 1 << 16  # the first of a rendered reference: both sides must not share a seed


@pytest.fixture
def assert_image_equal() -> Callable[..., Comparison]:
    """`assert_image_equal(test, reference, method="auto", **options)`: the verdict must be equal.

    The methods and their options are those of `mi-refract diff`. Inconclusive fails, too. Returns the comparison.
    """

    def check(test: Image, reference: Image, method: str = "auto", **options: Any) -> Comparison:
        __tracebackhide__ = True
        return _require_equal(method, lambda: (_image("reference", reference), _image("test", test)), options)

    return check


@pytest.fixture
def assert_image_unbiased() -> Callable[..., Comparison]:
    """`assert_image_unbiased(render, reference, runs=8, seed=0, **options)`: the means of renders must be equal.

    `render(seed)` returns an image; it is called with `runs` seeds from `seed` on. `reference` is a folder of
    independent renders, or a function like `render`, called with as many other seeds. Welch's t-test with its options;
    inconclusive fails, too: more runs or samples are needed then. Returns the comparison.
    """

    def check(
        render: Renderer, reference: Image | Renderer, runs: int = RUNS, seed: int = 0, **options: Any
    ) -> Comparison:
        __tracebackhide__ = True
        if runs < 2:
            raise ValueError(f"runs = {runs}; expected at least 2, to estimate the noise")

        from mi_refract.image_diff.file_pair import read_renders

        first = seed + REFERENCE_SEED
        known = [reference(i) for i in range(first, first + runs)] if callable(reference) else Path(reference)
        rendered = [render(i) for i in range(seed, seed + runs)]

        def sides() -> tuple[list[ReadImage], list[ReadImage]]:
            if isinstance(known, Path):
                references = read_renders(known)
            else:
                references = [_image(f"reference {first + i}", image) for i, image in enumerate(known)]
            return references, [_image(f"test {seed + i}", image) for i, image in enumerate(rendered)]

        return _require_equal("welch", sides, options)

    return check


def _require_equal(method: str, sides: Callable[[], tuple[Any, Any]], options: dict[str, Any]) -> Comparison:
    __tracebackhide__ = True
    from mi_refract.image_diff.comparison import Verdict
    from mi_refract.image_diff.methods import compare

    try:
        comparison = compare(method, *sides(), **options)
    except (ValueError, OSError) as error:
        pytest.fail(f"could not compare: {error}", pytrace=False)
    if comparison.verdict is not Verdict.EQUAL:
        lines = [f"{comparison.method}: {comparison.verdict}: {comparison.reason}"]
        for metric in comparison.metrics:
            bound = "" if metric.bound is None else f", at most {metric.bound:.6g}"
            lines.append(f"  {metric.name}: {metric.value:.6g}{bound}")
        pytest.fail("\n".join(lines), pytrace=False)
    return comparison


def _image(name: str, image: Image) -> ReadImage:
    from mi_refract.io import image_file

    return image_file.read(image) if isinstance(image, str | os.PathLike) else image_file.named(name, image)
