"""Fixtures for pytest that compare images, `assert_image_equal` and `assert_image_unbiased`, and two options.

Put this into the conftest.py of the tests: `pytest_plugins = ["mi_refract.pytest_plugin"]`. The plugin is no entry
point, because an entry point would load Mitsuba, and with it a libLLVM, into every pytest run of the environment,
before a conftest.py could choose one. An image is a file or an array, H × W × C or H × W; arrays of uint8 and uint16
are sRGB codes, as in a PNG file; an array of one channel takes the channel name of the file that it is compared with. A
missing reference fails the test.

`--mi-refract-accept` copies images that are not equal over their references, as `mi-refract accept` does, if both are
files, or if the reference is an EXR file and the image an array. `--mi-refract-report OUT.html` writes the page of
`mi-refract diff` about all comparisons. Both need a run in one process. Without these options nothing is written.
"""

from __future__ import annotations

import contextlib
import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from mi_refract.image_diff.comparison import Comparison
    from mi_refract.image_diff.html_report import Page
    from mi_refract.image_diff.results import Result, Results
    from mi_refract.io.image_file import Image as ReadImage

Image = Any  # the path of a file, or anything that NumPy converts to an array
Renderer = Callable[[int], Image]  # the argument: seed
RUNS = 8
REFERENCE_SEED = 1 << 16  # the first seed of a rendered reference: the sides must not share a seed

ACCEPT, REPORT = "--mi-refract-accept", "--mi-refract-report"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("mi-refract", "images")
    group.addoption(ACCEPT, action="store_true", help="copy images that are not equal over their references")
    group.addoption(REPORT, type=Path, metavar="OUT.html", help="write a page about the images that are not equal")


@dataclass(frozen=True)
class Compared:
    """The comparisons of a session, for the page."""

    page: Page
    results: list[Result] = field(default_factory=list)

    def add(self, result: Result) -> None:
        """Add a result; the page keeps the images that it shows."""
        from mi_refract.image_diff.folders import without_images
        from mi_refract.image_diff.results import FAILED

        if result.status in FAILED:
            self.page.view(result, self.as_results(Path()))
        self.results.append(without_images(result))

    def as_results(self, root: Path) -> Results:
        """Return the results, whose commands run pytest."""
        from mi_refract.image_diff.results import Results

        class TestResults(Results):
            def command(self, verb: str, *names: str, flags: Sequence[str] | None = None) -> str:
                words = [REPORT if word == "--report" else word for word in flags or ()]
                return shlex.join(["pytest", *words, *[ACCEPT] * (verb == "accept"), *names])

            def word(self, name: str) -> str:
                return name  # pytest has no patterns

        return TestResults(root, root, tuple(sorted(self.results, key=lambda result: result.order)))


COMPARED = pytest.StashKey[Compared]()
ACCEPTED = pytest.StashKey[dict[Path, str]]()  # the SHA-256 of each reference that an image of this run is or equals


def pytest_configure(config: pytest.Config) -> None:
    """Create the page. UsageError for an option in several processes, and if the page cannot be written."""
    several = config.getoption("numprocesses", None) or hasattr(config, "workerinput")
    for option in (ACCEPT, REPORT):
        if several and config.getoption(option, None):
            raise pytest.UsageError(f"{option}: the tests run in several processes; expected -n 0")
    if path := config.getoption(REPORT, None):
        from mi_refract.image_diff.html_report import Page
        from mi_refract.io.safe_files import writable

        try:
            config.stash[COMPARED] = Compared(Page(writable(path, (".html", ".htm"))))
        except (ValueError, OSError) as error:
            raise pytest.UsageError(str(error)) from None


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write the page."""
    if compared := session.config.stash.get(COMPARED, None):
        compared.page.write(compared.as_results(session.config.rootpath), {"pytest": pytest.__version__})


@pytest.fixture
def assert_image_equal(request: pytest.FixtureRequest) -> Callable[..., Comparison]:
    """`assert_image_equal(test, reference, method="auto", **options)`: fail unless the images are equal.

    The methods and their options are those of `mi-refract diff`. "Inconclusive" fails, too. Returns the comparison.
    """

    def check(test: Image, reference: Image, method: str = "auto", **options: Any) -> Comparison:
        __tracebackhide__ = True
        if request.config.getoption(ACCEPT, False) and isinstance(reference, str | os.PathLike):
            _accept(Path(reference), test, method, options, request.config.stash.setdefault(ACCEPTED, {}))

        def sides() -> tuple[ReadImage, ReadImage]:
            images = _image("reference", reference), _image("test", test)
            are_files = all(isinstance(side, str | os.PathLike) for side in (reference, test))
            if are_files and Path(reference).samefile(test):
                raise ValueError(f"{test}: the same file as the reference {reference}; expected two different files")
            one, two = images
            return _named_like(one, two), _named_like(two, one)

        return _require_equal(request, method, sides, options)

    return check


@pytest.fixture
def assert_image_unbiased(request: pytest.FixtureRequest) -> Callable[..., Comparison]:
    """`assert_image_unbiased(render, reference, runs=8, seed=0, **options)`: fail unless the means are equal.

    `render(seed)` returns an image; it is called with `runs` seeds from `seed` on. `reference`: a folder of independent
    renders, or a function like `render`, which is called with as many other seeds. The test is Welch's t-test with the
    options of `welch`. "Inconclusive" fails, too; more runs or samples are needed then. Returns the comparison.
    """

    def check(
        render: Renderer, reference: Image | Renderer, runs: int = RUNS, seed: int = 0, **options: Any
    ) -> Comparison:
        __tracebackhide__ = True
        if runs < 2:
            raise ValueError(f"runs = {runs}; expected at least 2, to estimate the noise")

        from mi_refract.image_diff.file_pair import read_renders

        def rendered(name: str, renderer: Renderer, first: int) -> list[ReadImage]:
            # Each image is copied at once: the next render may be in the same file or array.
            return [_image(f"{name} {i}", renderer(i)) for i in range(first, first + runs)]

        first = seed + REFERENCE_SEED
        references = rendered("reference", reference, first) if callable(reference) else Path(reference)
        tests = rendered("test", render, seed)

        def sides() -> tuple[list[ReadImage], list[ReadImage]]:
            renders = read_renders(references) if isinstance(references, Path) else references
            return [_named_like(x, tests[0]) for x in renders], [_named_like(x, renders[0]) for x in tests]

        return _require_equal(request, "welch", sides, options)

    return check


def _accept(reference: Path, test: Image, method: str, options: dict[str, Any], digests: dict[Path, str]) -> None:
    """Copy the image to the path of the reference, unless they are equal, or an array differs from its own EXR file.

    `digests`: the SHA-256 of each reference that an image of this run has become or equals; a copy of another image
    over one of them is an error.
    """
    __tracebackhide__ = True
    from mi_refract.image_diff import accept, folders, methods
    from mi_refract.image_diff.comparison import Verdict
    from mi_refract.image_diff.settings import Settings
    from mi_refract.io import image_file, safe_files

    try:
        with safe_files.temporary_folder() as folder:
            if not isinstance(test, str | os.PathLike):
                image, test = image_file.named("test", test), folder / "test.exr"
                existing: ReadImage | None = None
                with contextlib.suppress(ValueError, OSError):  # missing, or an error that the comparison reports
                    existing = image_file.read(reference)
                    image = _named_like(image, existing)
                image_file.write_exr(test, image.pixels, image.channels, image.metadata)
                held = methods.compare(method, image_file.read(test), image, **options)
                if held.verdict is Verdict.DIFFERENT:
                    if existing and methods.compare(method, existing, image, **options).is_equal:  # ids of 32 bits
                        digests.setdefault(reference.resolve(), safe_files.digest(reference))
                        return
                    reason = f"by {held.method}, the array differs from its EXR file: {held.reason}"
                    raise ValueError(f"{reference}: {reason}; expected values that float32 holds")
                options = options | {"ignore_metadata": ("*",)}  # an array has none
            settings = Settings.for_all(method=method, **options)
            copies = list(accept.changes(folders.diff(reference, test, settings, to_accept=True)))
            if not copies:
                digests.setdefault(reference.resolve(), safe_files.digest(reference))
            for copy in copies:
                if digests.setdefault(copy.reference.resolve(), copy.compared) != copy.compared:
                    raise ValueError(f"{copy.reference}: also the reference of another image; expected one of its own")
            accept.Acceptance(copies).run()
    except (ValueError, OSError) as error:
        pytest.fail(f"could not accept: {error}", pytrace=False)


def _require_equal(
    request: pytest.FixtureRequest, method: str, sides: Callable[[], tuple[Any, Any]], options: dict[str, Any]
) -> Comparison:
    """Compare both sides, add the result to the page, and fail the test unless they are equal."""
    __tracebackhide__ = True
    from mi_refract.image_diff.comparison import Verdict
    from mi_refract.image_diff.file_pair import mean_image
    from mi_refract.image_diff.methods import compare
    from mi_refract.image_diff.results import Result, Status
    from mi_refract.image_diff.settings import ComparisonSpec

    path, colon, rest = request.node.nodeid.partition("::")  # relative to pytest's root
    with contextlib.suppress(ValueError):  # on another drive
        path = os.path.relpath(request.config.rootpath / path, request.config.invocation_params.dir)
    name, compared = Path(path).as_posix() + colon + rest, request.config.stash.get(COMPARED, None)
    result = Result(name, Status.ERROR, Path("reference"), Path("test"), ComparisonSpec(method))
    if compared:  # number the result, because a test may compare several images
        result = replace(result, target=Path(str(len(compared.results))))
    try:
        reference, test = sides()
        comparison = compare(method, reference, test, **options)
    except (ValueError, OSError) as error:
        if compared:
            compared.add(replace(result, error=str(error)))
        pytest.fail(f"could not compare: {error}", pytrace=False)
    if compared:
        images = [mean_image(side) if isinstance(side, list) else side for side in (reference, test)]
        shown = dict(zip(("reference", "test"), images, strict=True))
        compared.add(replace(result, status=Status(str(comparison.verdict)), comparison=comparison, images=shown))
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


def _named_like(image: ReadImage, other: ReadImage) -> ReadImage:
    """Return the image; if it is an array of one channel, with the name of the single channel of a file."""
    is_gray = len(image.channels) == len(other.channels) == 1 and other.stored and not image.stored
    return replace(image, channels=other.channels) if is_gray else image
