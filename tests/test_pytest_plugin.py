"""The fixtures for pytest, in these tests and in separate runs of pytest."""

import html
import re
import shlex
from types import SimpleNamespace

import numpy as np
import OpenImageIO  # noqa: F401  it loads only once, and pytester removes the modules that a test imports
import pytest
from support.diff_images import save
from support.processes import python
from support.readme import DOCS, python_blocks

from mi_refract.image_diff.html_report import Page
from mi_refract.io import image_file

pytest_plugins = ["pytester", "mi_refract.pytest_plugin"]
IMAGE = np.linspace(0.2, 1, 32 * 32 * 3).reshape(32, 32, 3)


def render(seed, gain=1.0):
    return gain * IMAGE * np.random.default_rng(seed).gamma(400, 1 / 400, IMAGE.shape)


def test_equal_images_pass(assert_image_equal, assert_image_unbiased, tmp_path):
    assert assert_image_equal(IMAGE, IMAGE).method == "tolerance"
    assert_image_equal(IMAGE + 1e-5, IMAGE, "tolerance")
    assert_image_equal(IMAGE[..., 0], IMAGE[..., 0], "exact")
    for name in ("image.exr", "copy.exr"):
        image_file.write_exr(tmp_path / name, IMAGE)
    assert_image_equal(IMAGE, tmp_path / "image.exr", "paired")
    assert_image_equal(str(tmp_path / "image.exr"), tmp_path / "copy.exr", "exact")
    assert assert_image_unbiased(render, render).method == "welch"
    (tmp_path / "renders").mkdir()
    for i in range(8):
        image_file.write_exr(tmp_path / "renders" / f"{i}.exr", render(100 + i))
    assert_image_unbiased(render, tmp_path / "renders", runs=6)


def test_a_gray_array_is_compared_with_a_gray_file(assert_image_equal, assert_image_unbiased, tmp_path):
    """In an array, the channel has no name; those of files count."""
    codes = np.arange(256, dtype=np.uint8).reshape(16, 16)
    files = [save(tmp_path / "gray.png", codes[..., None], "uint8")]
    for name in ("Y", "depth"):
        image_file.write_exr(tmp_path / f"{name}.exr", IMAGE[..., :1], (name,))
        files.append(tmp_path / f"{name}.exr")
    for file, array in zip(files, (codes, IMAGE[..., 0], IMAGE[..., 0].astype(np.float32)), strict=True):
        assert_image_equal(file, array)
        assert_image_equal(array[..., None], file)
        with pytest.raises(pytest.fail.Exception, match="different: "):
            assert_image_equal(array[::-1], file)
        with pytest.raises(pytest.fail.Exception, match=r"could not compare: .*channel1"):
            assert_image_equal(np.dstack([array] * 2), file)
    with pytest.raises(pytest.fail.Exception, match=r"could not compare: .*depth"):
        assert_image_equal(files[1], files[2])
    (tmp_path / "renders").mkdir()
    for i in range(8):
        image_file.write_exr(tmp_path / "renders" / f"{i}.exr", render(100 + i)[..., :1], ("Y",))
    assert_image_unbiased(lambda seed: render(seed)[..., 0], tmp_path / "renders", runs=6)
    as_file = lambda seed: tmp_path / "renders" / f"{seed % 8}.exr"  # noqa: E731
    assert_image_unbiased(as_file, lambda seed: render(seed)[..., 0], runs=6)
    assert_image_unbiased(lambda seed: render(seed)[..., 0], as_file, runs=6)


def test_the_documented_test_passes(assert_image_equal, assert_image_unbiased, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, image in {"out/ball": IMAGE, "references/ball": IMAGE + 1e-3, "references/ball/a": render(100)}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        image_file.write_exr(tmp_path / f"{name}.exr", image)
    image_file.write_exr(tmp_path / "references/ball/b.exr", render(101))
    (code,) = python_blocks(DOCS / "how-to/compare-images-in-pytest.md")
    exec(code, names := {"mi": SimpleNamespace(render=lambda scene, seed: render(seed)), "scene": None})
    names["test_ball"](assert_image_equal, assert_image_unbiased)


@pytest.mark.parametrize(
    ("test", "method", "options", "reason"),
    [
        (IMAGE + 1e-5, "exact", {}, "exact: different: "),
        (1.1 * IMAGE, "auto", {}, "tolerance: different: "),
        (1.1 * IMAGE, "paired", {}, r"paired: different: (.|\n)*, at most "),
        (IMAGE * np.nan, "exact", {}, "exact: different: "),
        (IMAGE[:-1], "auto", {}, "could not compare: "),
        ("missing.exr", "auto", {}, "could not compare: .*missing.exr"),  # the reference is not created
        (["no numbers"], "auto", {}, "could not compare: "),
        (np.full((4, 4), 2**53 + 1), "exact", {}, "could not compare: .*: int64 up to ±9007199254740993; expected "),
        (np.full((4, 4), 2**64 - 1, np.uint64), "exact", {}, "could not compare: .*; expected integers up to 2⁵³"),
        (np.full((4, 4), -(2**63)), "exact", {}, "could not compare: .*; expected integers up to 2⁵³"),
        (IMAGE, "telepathy", {}, "could not compare: method 'telepathy'; expected "),
        (IMAGE, "exact", {"threshold": 1}, "could not compare: "),
    ],
)
def test_different_images_fail_with_a_reason(assert_image_equal, tmp_path, monkeypatch, test, method, options, reason):
    monkeypatch.chdir(tmp_path)
    reference = IMAGE if isinstance(test, list | str) or np.isfinite(test).all() else test  # NaN differs from itself
    for sides in ((test, reference), (reference, test)):
        with pytest.raises(pytest.fail.Exception, match=reason):
            assert_image_equal(*sides, method, **options)
    assert not list(tmp_path.iterdir())


def test_a_file_is_not_compared_with_itself(assert_image_equal, tmp_path):
    image_file.write_exr(tmp_path / "a.exr", IMAGE)
    (tmp_path / "link.exr").symlink_to("a.exr")
    for name in ("a.exr", "link.exr"):
        with pytest.raises(pytest.fail.Exception, match=r"could not compare: .*: the same file as the reference"):
            assert_image_equal(str(tmp_path / name), tmp_path / "a.exr")


def test_biased_and_inconclusive_renders_fail(assert_image_unbiased, tmp_path):
    with pytest.raises(pytest.fail.Exception, match="welch: different: "):
        assert_image_unbiased(lambda seed: render(seed, 1.03), render)
    with pytest.raises(pytest.fail.Exception, match="welch: inconclusive: "):
        assert_image_unbiased(render, render, runs=2, resolution=1e-6)
    for folder, reason in ((tmp_path, "contains no image"), (tmp_path / "none", "No such file or directory")):
        with pytest.raises(pytest.fail.Exception, match=f"could not compare: .*{reason}"):
            assert_image_unbiased(render, folder)
    with pytest.raises(ValueError, match="runs = 1; expected at least 2"):
        assert_image_unbiased(render, render, runs=1)


def test_errors_of_render_functions_are_raised_and_seeds_are_distinct(assert_image_unbiased):
    seeds = {"test": [], "reference": [], "broken": []}

    def watched(side):
        return lambda seed: seeds[side].append(seed) or render(seed)

    def broken(seed):
        raise ValueError("my own")

    for sides in ((broken, watched("broken")), (watched("broken"), broken)):
        with pytest.raises(ValueError, match="my own"):
            assert_image_unbiased(*sides)
    assert_image_unbiased(watched("test"), watched("reference"), runs=5, seed=7)
    assert seeds["test"] == list(range(7, 12)) and len(seeds["reference"]) == 5
    assert not set(seeds["test"]) & set(seeds["reference"])


@pytest.mark.parametrize("in_file", [False, True])
def test_renders_in_the_same_array_or_file_are_distinguished(assert_image_unbiased, tmp_path, in_file):
    buffer = np.empty_like(IMAGE)

    def reused(gain):
        def render_again(seed):
            buffer[:] = render(seed, gain)
            image_file.write_exr(tmp_path / "a.exr", buffer)
            return tmp_path / "a.exr" if in_file else buffer

        return render_again

    assert_image_unbiased(reused(1), reused(1))
    with pytest.raises(pytest.fail.Exception, match="welch: different: "):
        assert_image_unbiased(reused(2), reused(1))


TESTS = """
import numpy as np
import pytest

def test_new(assert_image_equal):
    assert_image_equal(np.full((8, 8, 3), 200, np.uint8), "new.exr", "flip")

def test_changed(assert_image_equal):
    assert_image_equal("test.exr", "old.exr", "exact")

def test_equal(assert_image_equal):
    assert_image_equal(np.zeros((8, 8, 3)), "zero.exr")

def test_equal_to_a_png(assert_image_equal):
    assert_image_equal(np.zeros((8, 8, 3)), "zero.png")

def test_two_arrays(assert_image_equal):
    assert_image_equal(np.ones((8, 8, 3)), np.zeros((8, 8, 3)))

@pytest.mark.parametrize("name", ["a*\u2081"])
def test_wrong_option(assert_image_equal, name):
    assert_image_equal("test.exr", "old.exr", "exact", fial=1)
"""


def test_options_write_a_page_and_accept_images(pytester):
    """In separate processes, because a run in this process would import extension modules twice, which fails."""
    pytester.makeconftest('pytest_plugins = ["mi_refract.pytest_plugin"]')
    name = f"{pytester.makepyfile(TESTS).name}::test_"
    for file, value in {"old": 0, "test": 1, "zero": 0}.items():
        pixels = np.full((8, 8, 3), value, np.float32)
        image_file.write_exr(pytester.path / f"{file}.exr", pixels, metadata={"view": "left"})
    save(pytester.path / "zero.png", np.zeros((8, 8, 3)), "uint8")
    before = {path.name: path.read_bytes() for path in pytester.path.glob("*.exr")}

    def run(*words):
        return pytester.runpytest_subprocess("-p", "no:cacheprovider", *words)

    run("--mi-refract-report", "out.html").assert_outcomes(passed=2, failed=4)
    page = (pytester.path / "out.html").read_text("utf-8")
    assert "6 images: 2 could not be compared, 2 different, 2 equal" in page
    assert f"pytest {name}changed" in page and f"pytest --mi-refract-accept {name}changed" in page
    word = shlex.quote(rf"{name}wrong_option[a*\u2081]")  # as pytest writes it
    assert f"pytest {word}" in html.unescape(page) and f'data-word="{word}"' in html.unescape(page)
    assert page.count('data-role="difference"') == 2
    assert {path.name: path.read_bytes() for path in pytester.path.glob("*.exr")} == before  # nothing is written
    accepted = run("--mi-refract-accept")
    accepted.assert_outcomes(passed=4, failed=2)
    accepted.stdout.fnmatch_lines(["could not accept: settings: unknown key `fial`; expected *"])
    after = {path.name: path.read_bytes() for path in pytester.path.glob("*.exr")}
    assert after == before | {"old.exr": before["test.exr"], "new.exr": after["new.exr"]}


def test_the_commands_of_a_page_run_in_the_folder_that_pytest_ran_in(pytester, monkeypatch):
    pytester.makeini("[pytest]")
    pytester.makeconftest('pytest_plugins = ["mi_refract.pytest_plugin"]')
    folder = pytester.mkdir("below")
    (folder / "test_below.py").write_text(TESTS, "utf-8")
    monkeypatch.chdir(folder)
    pytester.runpytest_subprocess("-p", "no:cacheprovider", "--mi-refract-report", "out.html")
    page = (folder / "out.html").read_text("utf-8")
    assert "pytest test_below.py::test_changed" in page and "below/test_below.py" not in page


@pytest.mark.parametrize("exists", [False, True])
def test_a_reference_is_not_accepted_for_two_images(pytester, exists):
    """Neither if the first image becomes the reference, nor if it equals the reference."""
    if exists:
        image_file.write_exr(pytester.path / "new.exr", np.ones((8, 8, 3)))
    pytester.makeconftest('pytest_plugins = ["mi_refract.pytest_plugin"]')
    pytester.makepyfile("""
        import numpy as np
        import pytest

        @pytest.mark.parametrize("value", [1, 1.001, 2])
        def test_new(assert_image_equal, value):
            assert_image_equal(np.full((8, 8, 3), value), "new.exr", "tolerance")
    """)
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider", "--mi-refract-accept")
    result.assert_outcomes(passed=2, failed=1)
    result.stdout.fnmatch_lines(["could not accept: *new.exr: also the reference of another image; expected *"])


def test_an_accepted_gray_array_keeps_the_channel_of_its_reference(pytester):
    pytester.makeconftest('pytest_plugins = ["mi_refract.pytest_plugin"]')
    pytester.makepyfile("""
        import numpy as np
        import pytest

        @pytest.mark.parametrize("name", ["equal", "changed", "new", "broken"])
        def test_gray(assert_image_equal, name):
            assert_image_equal(np.ones((8, 8)), f"{name}.exr", "exact")
    """)
    for name, value in (("equal", 1), ("changed", 2)):
        image_file.write_exr(pytester.path / f"{name}.exr", np.full((8, 8, 1), value), ("Y",))
    (pytester.path / "broken.exr").write_bytes(b"")
    before = (pytester.path / "equal.exr").read_bytes()
    pytester.runpytest_subprocess("-p", "no:cacheprovider", "--mi-refract-accept").assert_outcomes(passed=4)
    assert (pytester.path / "equal.exr").read_bytes() == before
    channels = {path.stem: image_file.read(path).channels for path in pytester.path.glob("*.exr")}
    assert channels == {"equal": ("Y",), "changed": ("Y",), "new": ("channel0",), "broken": ("channel0",)}


def test_an_array_that_float32_does_not_hold_is_not_accepted(pytester):
    """It would differ from its file at every run."""
    pytester.makeconftest('pytest_plugins = ["mi_refract.pytest_plugin"]')
    pytester.makepyfile("""
        import numpy as np
        import pytest

        @pytest.mark.parametrize("name", ["old.exr", "new.exr"])
        @pytest.mark.parametrize("value", [0.1, 2**24 + 1])
        def test_wide(assert_image_equal, name, value):
            assert_image_equal(np.full((8, 8, 3), value), name, "exact")

        @pytest.mark.parametrize(("value", "method"), [(0.5, "exact"), (0.1, "tolerance")])
        def test_held(assert_image_equal, value, method):
            assert_image_equal(np.full((8, 8, 3), value), f"{method}.exr", method)

        def test_equal_ids(assert_image_equal):
            assert_image_equal(np.full((8, 8, 3), 2**24 + 1), "ids.exr", "exact")
    """)
    image_file.write_exr(pytester.path / "old.exr", np.ones((8, 8, 3)))
    save(pytester.path / "ids.exr", np.full((8, 8, 3), 2**24 + 1, np.uint32), "uint")
    before = {path.name: path.read_bytes() for path in pytester.path.glob("*.exr")}
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider", "--mi-refract-accept")
    result.assert_outcomes(passed=3, failed=4)
    result.stdout.fnmatch_lines(["could not accept: *.exr: *; expected values that float32 holds"] * 4)
    after = {path.name: path.read_bytes() for path in pytester.path.glob("*.exr")}
    assert after == before | {name: after[name] for name in ("exact.exr", "tolerance.exr")}


def test_the_page_shows_all_images_of_a_test(request, assert_image_equal, tmp_path):
    """Even if their metrics are equal."""
    from mi_refract.pytest_plugin import COMPARED, Compared  # pytest imports it first

    compared = request.config.stash[COMPARED] = Compared(Page(tmp_path / "out.html"))
    for pixels in np.split(np.eye(2), 2):
        with pytest.raises(pytest.fail.Exception):
            assert_image_equal(np.repeat(pixels, 3, 0), np.zeros((3, 2)), "exact")
    del request.config.stash[COMPARED]
    compared.page.write(compared.as_results(tmp_path), {})
    shown = re.findall(r'id="p\d"[^>]*>([^<]+)<', (tmp_path / "out.html").read_text("utf-8"))
    assert len(shown) % 2 == 0 and shown[: len(shown) // 2] != shown[len(shown) // 2 :]


def test_the_page_shows_the_mean_of_renders(request, assert_image_unbiased, tmp_path, monkeypatch):
    """Only the page keeps images, because those of hundreds of tests would fill the memory."""
    from mi_refract.pytest_plugin import COMPARED, Compared  # pytest imports it first

    viewed = []
    monkeypatch.setattr(Page, "view", lambda self, result, results: viewed.append(result))
    compared = request.config.stash[COMPARED] = Compared(Page(tmp_path / "out.html"))
    with pytest.raises(pytest.fail.Exception):
        assert_image_unbiased(lambda seed: render(seed, 1.1), render, runs=2)
    del request.config.stash[COMPARED]
    assert [(dict(result.images), result.comparison.maps) for result in compared.results] == [({}, {})]
    (result,) = viewed
    mean = np.mean([render(seed, 1.1) for seed in (0, 1)], 0)
    np.testing.assert_allclose(result.images["test"].pixels, mean, rtol=1e-6)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--mi-refract-report", "out.txt"], "expected a file name that ends in"),
        (["--mi-refract-report", "out.html", "-n2"], "--mi-refract-report: .*; expected -n 0"),
        (["--mi-refract-accept", "-n2"], "--mi-refract-accept: .*; expected -n 0"),
    ],
)
def test_a_page_that_cannot_be_written_and_several_processes_are_usage_errors(pytester, words, message):
    with pytest.raises(pytest.UsageError, match=message):
        pytester.parseconfigure("-p", "mi_refract.pytest_plugin", *words)


def test_the_plugin_imports_no_renderer():
    code = "import sys, mi_refract.pytest_plugin; print({'mitsuba', 'drjit', 'numpy', 'OpenImageIO'} & {*sys.modules})"
    out, err = python(code).communicate()
    assert (out, err) == ("set()\n", "")
