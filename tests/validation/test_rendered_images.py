"""Images by other renderers: verdicts on renderers that agree, that differ, and that are not installed."""

import dataclasses
import re

import numpy as np
import pytest

from mi_refract import media
from mi_refract.image_diff.comparison import Verdict
from mi_refract.io import image_file
from mi_refract.io.errors import ExportError
from mi_refract.scene_export import targets
from mi_refract.scene_export.plain_scene import Diffuse, Glass, Light
from validation import limits
from validation.run.context import PROFILES, Context
from validation.suite import exports, matrix, rendered_images, spectral_lines
from validation.suite.rendered_images import INCONCLUSIVE, THREE, Size
from validation.suite.renderers import SYSTEMS, environments
from validation.suite.renderers.image_renderers import IMAGE_RENDERERS, ImageRenderer

SMALL = Size(48, 32, 1, 0.2)
pytestmark = pytest.mark.usefixtures("llvm_variant")


@pytest.fixture
def context(tmp_path, monkeypatch):
    """A context of the profile `full`, with all renderers reported as installed, and small images."""
    monkeypatch.setattr(environments, "absent", lambda system: "")
    monkeypatch.setitem(rendered_images.SIZES, "full", SMALL)
    monkeypatch.setitem(spectral_lines.SIZES, "full", Size(32, 64, 4, 0.3))
    return Context(PROFILES["full"], tmp_path, "llvm_ad_rgb", {}, {spectral_lines.VARIANT: None})


def raising(error):
    def draw(*_):
        raise error

    return draw


NOT_DRAWN = [(environments.Unable("no browser"), "not run"), (environments.Broken("exit code 1"), "fail")]


def denser(plain):
    """The scene with another index of its glass."""
    materials = (mesh.material for mesh in plain.meshes)
    glasses = [dataclasses.replace(x, int_ior=2.0) if isinstance(x, Glass) else x for x in materials]
    meshes = (dataclasses.replace(mesh, material=glass) for mesh, glass in zip(plain.meshes, glasses, strict=True))
    return dataclasses.replace(plain, meshes=tuple(meshes))


@pytest.fixture
def judged(context, monkeypatch):
    """`judged(change)`: the row of a renderer that renders the changed prism by Mitsuba's `dielectric`."""

    def judge(change=lambda plain: plain, title="Radiance", draw=None):
        path = IMAGE_RENDERERS["Mitsuba, volpath"].draw
        draw = draw or (lambda plain, *rest: path(change(plain), *rest))
        monkeypatch.setitem(IMAGE_RENDERERS, title, ImageRenderer("radiance", draw, {"prism": 32}, ()))
        [row] = rendered_images.pair_rows(context, title, "prism")
        assert all((context.out / name).is_file() for name in row.images.values())
        return row

    return judge


def test_verdicts_on_equal_different_and_noisy_images(judged, monkeypatch):
    row = judged()
    assert (row.verdict, row.replay["verdict"], row.missed) == ("pass", "equal", {})
    assert row.values["RMSE / noise"] == pytest.approx(1, abs=0.1)
    assert list(row.images) == ["reference", "test", "difference"]
    wider = lambda plain: dataclasses.replace(plain, camera=dataclasses.replace(plain.camera, fov_x_degrees=34.0))  # noqa: E731
    for change in (denser, wider):
        row = judged(change)
        assert (row.verdict, row.replay["verdict"]) == ("fail", "different") and row.values["tests that differ"] > 0
    assert judged(draw=IMAGE_RENDERERS[rendered_images.PTRACER].draw).verdict == "fail"  # its glass is black
    assert judged(title=THREE).broken == {"not seen to differ": 0.0}  # a known difference must be detected
    row = judged(denser, THREE)
    assert row.verdict == "pass" and rendered_images.WHY[THREE] in row.reason
    monkeypatch.setitem(rendered_images.SIZES, "full", dataclasses.replace(SMALL, wanted=1e-3))
    row = judged()
    assert row.replay["verdict"] == "inconclusive" and row.missed[INCONCLUSIVE] == 0
    [cell] = matrix.summary([row])
    assert INCONCLUSIVE in cell.missed and "inconclusive" in cell.reason
    assert INCONCLUSIVE not in judged(denser).missed


def test_failed_renders_and_nan_never_pass(judged, monkeypatch):
    def draw_nan(*arguments):
        images = IMAGE_RENDERERS["Mitsuba, volpath"].draw(*arguments)
        images[0].pixels[3, 4] = np.nan
        return images

    row = judged(draw=draw_nan)
    assert row.verdict == "fail" and "NaN" in row.reason
    answers = (ExportError("a diffuse surface"), "not run"), (ValueError("no image: channels Y"), "fail")
    for error, verdict in (*NOT_DRAWN, *answers):
        row = judged(draw=raising(error))
        assert row.verdict == verdict and str(error) in row.reason
    monkeypatch.setattr(environments, "absent", lambda system: "the command that installs it")
    row = judged(draw=raising(AssertionError("it was run")))
    assert (row.verdict, row.reason) == ("not run", "the command that installs it")


NO_VALIDATOR = environments.absent(SYSTEMS[exports.VALIDATOR])

# Exports -----------------------------------------------------------------------------------------------------------

DEFECTS = {
    "nothing": ("README.txt", "$^", ""),
    "vertical angle of view": ("camera.vf", r"-vh (\S+) -vv \S+", r"-vh \1 -vv \1"),
    "no diffuse light": ("README.txt", r"-ab \d+", "-ab 0"),
    "sky": ("sky.cal", r"Acos\(y\)", "Acos(-y)"),
}


@pytest.mark.parametrize("title", [title for title in IMAGE_RENDERERS if title not in exports.LEFT_OUT])
def test_installed_renderers_render_the_exports_as_mitsuba_does(title, tmp_path):
    if reason := environments.absent(SYSTEMS[IMAGE_RENDERERS[title].system]):
        pytest.skip(f"{title}: {reason}")
    (row,) = exports.rows(Context(PROFILES["full"], tmp_path, "llvm_ad_rgb", {}, {}), title)
    assert row.verdict == "pass", (row.values, row.reason)


@pytest.mark.parametrize("defect", DEFECTS)
def test_defects_of_an_export_are_detected(defect, monkeypatch, tmp_path):
    """With an eighth of the samples, for which the allowance is larger."""
    if reason := environments.absent(SYSTEMS["radiance"]):
        pytest.skip(reason)
    make, (name, pattern, new) = targets.TARGETS["radiance"], DEFECTS[defect]

    def files(plain):
        exported = make(plain)
        return exported | {name: re.sub(pattern, new, exported[name].decode()).encode()}

    monkeypatch.setitem(targets.TARGETS, "radiance", files)
    monkeypatch.setattr(exports, "THEIRS", {title: spp // 8 for title, spp in exports.THEIRS.items()})
    (row,) = exports.rows(Context(PROFILES["full"], tmp_path, "llvm_ad_rgb", {}, {}), "Radiance")
    assert (exports.OVER in row.broken) == (defect != "nothing"), row.values


def renders(seed, mean=1.0, noise=0.02):
    return mean + noise * np.random.default_rng(seed).normal(size=(4, 9, 16, 3))


def test_the_allowance_of_exports_is_noise_and_one_percent(context, monkeypatch):
    over = lambda *pair: exports.compared(*pair)[exports.OVER]  # noqa: E731
    assert max(over(renders(1), renders(2)), over(renders(1), renders(2, mean=1.008))) < 1
    assert over(renders(1), renders(2, mean=1.06)) > 1
    values = exports.compared(renders(1, noise=0.1), renders(2, noise=0.1))
    assert values[exports.OVER] < 1 and values[exports.NOISE] > limits.EXPORT_NOISE
    with_nan = renders(2)
    with_nan[0, 3, 4] = np.nan
    monkeypatch.setattr(exports, "reference", lambda shown: renders(1))
    draws = (lambda title: with_nan, "fail"), *((raising(error), verdict) for error, verdict in NOT_DRAWN)
    for draw, verdict in draws:
        monkeypatch.setattr(exports, "drawn", draw)
        assert [row.verdict for row in exports.rows(context, "Radiance")] == [verdict]


def test_the_scene_of_exports_is_not_symmetric():
    """A mirrored or rotated image differs by more than is allowed."""
    image = exports.reference("no patch")
    for mirrored in (image[:, ::-1], image[:, :, ::-1], image[:, ::-1, ::-1]):
        assert exports.compared(image, mirrored)[exports.OVER] > 2


@pytest.mark.skipif(NO_VALIDATOR != "", reason=NO_VALIDATOR)
@pytest.mark.parametrize(
    "scene, old, new, verdict",
    [
        ("prism", b"", b"", "pass"),
        ("prism", b'"transmissionFactor":1.0', b'"transmissionFactor":9.0', "fail"),
        ("lamps", b"", b"", "pass"),
        ("lamps", b'"light":0', b'"light":9', "fail"),
        ("lamps", b'"byteStride":12', b'"byteStride": 8', "fail"),
        ("furnace", b"", b"", "not run"),
    ],
)
def test_khronos_validator_detects_invalid_gltf(scene, old, new, verdict, context, monkeypatch, tmp_path):
    """A scene that glTF cannot represent is not run, with the reason."""
    for name in ("meshes", f"{scene}.xml") if scene != "lamps" else ():
        (tmp_path / name).symlink_to(exports.SCENES / name)
    make = targets.TARGETS["gltf"]
    monkeypatch.setitem(
        targets.TARGETS, "gltf", lambda plain: {name: data.replace(old, new) for name, data in make(plain).items()}
    )
    monkeypatch.setattr(exports, "SCENES", tmp_path)
    (row,) = (row for row in exports.validated(context) if row.case == scene)
    assert (row.case, row.verdict) == (scene, verdict), row.values
    assert "touch" in row.reason if verdict == "not run" else row.values[exports.WARNINGS] == 0


# Spectral lines ------------------------------------------------------------------------------------------------------


def stripe(seed, noise, shift, line):
    """Four renders of a bright stripe, at a different position for each line."""
    rng, position = np.random.default_rng(seed), 9 + shift + {"C": 0, "d": 4, "F": 12}[line]
    images = (0.1 + (np.abs(np.arange(32) - position) < 3)) * (1 + noise * rng.normal(size=(4, 32, 32)))
    return [image_file.named(f"{seed} {i}", image[..., None].astype(np.float32)) for i, image in enumerate(images)]


@pytest.mark.parametrize(
    ("noise", "shifts", "verdicts"),
    [
        (0.01, {}, ["pass"] * 5),
        (0.01, {"F": 2}, ["pass", "pass", "fail", "pass", "pass"]),
        (3.0, {}, ["fail"] * 5),
        (0.01, {"C": 4, "F": -8}, ["fail", "pass", "fail", "fail", "fail"]),  # as if dispersion were left out
    ],
)
def test_equal_lines_pass_and_shifted_or_mixed_lines_fail(noise, shifts, verdicts, context, monkeypatch):
    monkeypatch.setattr(spectral_lines, "ours", lambda line, size: stripe(1, noise, 0, line))
    monkeypatch.setattr(spectral_lines, "theirs", lambda line, size: stripe(2, noise, shifts.get(line, 0), line))
    rows = [row for task in spectral_lines.tasks(context) for row in task.run()]
    assert [row.verdict for row in rows] == verdicts
    assert (INCONCLUSIVE in rows[0].missed) == (noise > 1)
    for error, verdict in NOT_DRAWN:
        monkeypatch.setattr(spectral_lines, "theirs", raising(error))
        assert spectral_lines.line_rows(context, "C")[0].verdict == verdict
        assert {row.verdict for row in spectral_lines.mixed_rows(context)} == {verdict}


def test_the_scene_of_spectral_lines_is_grey_has_raysects_glass_and_differs_between_lines(needs_variant):
    """Indices are those of raysect 0.9. The sky has its radiance in each line."""
    plain = spectral_lines.plain(16)
    colours = [mesh.material.reflectance for mesh in plain.meshes if isinstance(mesh.material, Diffuse)]
    colours += [mesh.material.radiance for mesh in plain.meshes if isinstance(mesh.material, Light)]
    assert len(colours) == 3 and all(len(set(colour)) == 1 for colour in (*colours, plain.sky))
    for line, index in {"C": 1.775987679010179, "d": 1.7847198458559292, "F": 1.8064543854708786}.items():
        assert float(media.index(spectral_lines.INDEX, media.LINES[line])) == pytest.approx(index, rel=1e-15)
    needs_variant(spectral_lines.VARIANT)
    size = Size(32, 256, 1, 0.3)
    one = {line: spectral_lines.ours(line, size) for line in "CF"}
    for images in one.values():
        assert images[0].pixels[0, 0, 0] == pytest.approx(plain.sky[0], rel=1e-3)
    assert spectral_lines.compared(one["C"], one["F"], size)[0].verdict is Verdict.DIFFERENT


def test_an_error_of_an_export_is_not_taken_for_a_scene_that_its_format_cannot_hold(context, monkeypatch, tmp_path):
    def broken(plain):
        raise ValueError("operands could not be broadcast together")

    (tmp_path / "prism.xml").symlink_to(exports.SCENES / "prism.xml")  # without its mesh
    monkeypatch.setattr(exports, "SCENES", tmp_path)
    monkeypatch.setattr(environments, "why_not", lambda system, profile: "")
    monkeypatch.setitem(targets.TARGETS, "gltf", broken)
    assert {row.case: row.verdict for row in exports.validated(context)} == {"prism": "fail", "lamps": "fail"}
