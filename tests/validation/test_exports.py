"""Exported scenes, rendered by their renderers where they are installed; what an export could get wrong is seen."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from mi_refract.scene_export import write_files
from mi_refract.scene_export.targets import luxcore, povray, scene_json
from mi_refract.scene_export.targets.shared_files import sky_exr
from validation import limits
from validation.suite import exports
from validation.suite.renderers import SYSTEMS, environments
from validation.suite.renderers.image_renderers import IMAGE_RENDERERS

FULL, STANDARD = (
    SimpleNamespace(profile=SimpleNamespace(name=name), variant="llvm_ad_rgb") for name in ("full", "standard")
)
TITLES = [title for title in IMAGE_RENDERERS if title not in exports.LEFT_OUT]
pytestmark = pytest.mark.usefixtures("llvm_variant")


@pytest.fixture
def needs():
    def check(title):
        if reason := environments.absent(SYSTEMS[IMAGE_RENDERERS[title].system]):
            pytest.skip(f"{title}: {reason}")

    return check


@pytest.mark.parametrize("title", TITLES)
def test_an_export_is_rendered_as_mitsuba_renders_the_scene(title, needs):
    needs(title)
    (row,) = exports.rows(FULL, title)
    if row.verdict == "not run":
        pytest.skip(f"{title}: {row.reason}")
    assert row.verdict == "pass", (row.values, row.reason)


DEFECTS = {
    "LuxCore: indices": (
        "scene.scn",
        r"interiorior = (.*)\n(.*)exteriorior = (.*)",
        r"interiorior = \3\n\2exteriorior = \1",
    ),
    "LuxCore: sky": luxcore.direction_at,
    "Cycles: index": ("render.py", r'entry\["int_ior"\] / entry\["ext_ior"\]', 'entry["ext_ior"] / entry["int_ior"]'),
    "Cycles: sky": scene_json.cycles_direction_at,
    "POV-Ray: camera mirrored": ("scene.pov", "right Right", "right -Right"),
    "POV-Ray: sky": povray.direction_at,
    "Radiance: vertical angle of view": ("camera.vf", r"-vh (\S+) -vv \S+", r"-vh \1 -vv \1"),
    "Radiance: no diffuse light": ("README.txt", r"-ab \d+", "-ab 0"),
    "Radiance: sky": ("sky.cal", r"Acos\(y\)", "Acos(-y)"),
    "raysect: rays weighed": ("render.py", r"\(ray, 1\.0\) for ray, _", "(ray, w) for ray, w"),
    "raysect: scene too large": ("render.py", r"SIZE, FAR = 0\.5", "SIZE, FAR = 500"),
    "raysect: indices": ("render.py", r'\(entry\["int_ior"\]', '(entry["ext_ior"]'),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_defect_of_an_export_is_seen(defect, needs, monkeypatch):
    """Also with an eighth of the samples: noise makes the allowance larger."""
    title, change = defect.partition(":")[0], DEFECTS[defect]
    needs(title)
    target = IMAGE_RENDERERS[title].system
    make = write_files.TARGETS[target]

    def files(plain):
        made = make(plain)
        if callable(change):
            return made | sky_exr(plain, lambda u, v: change(u, 1 - v))
        name, pattern, new = change
        text, count = re.subn(pattern, new, made[name].decode())
        assert count, pattern
        return made | {name: text.encode()}

    monkeypatch.setitem(write_files.TARGETS, target, files)
    monkeypatch.setattr(exports, "THEIRS", {name: spp // 8 for name, spp in exports.THEIRS.items()})
    (row,) = exports.rows(FULL, title)
    assert exports.OVER in row.broken, row.values


# The comparison ----------------------------------------------------------------------------------------------------


def renders(seed, mean=1.0, noise=0.02, shape=(4, 9, 16, 3)):
    return mean + noise * np.random.default_rng(seed).normal(size=shape)


def test_what_is_allowed_is_noise_and_one_percent():
    ours = renders(1)
    assert exports.compared(ours, renders(2))[exports.OVER] < 1
    assert exports.compared(ours, renders(2, mean=1.008))[exports.OVER] < 1
    assert exports.compared(ours, renders(2, mean=1.06))[exports.OVER] > 1
    mirrored = np.linspace(0.8, 1.2, 16)[:, None]
    assert exports.compared(ours * mirrored, renders(2) * mirrored[::-1])[exports.OVER] > 1


def test_noise_that_could_hide_a_defect_fails():
    values = exports.compared(renders(1, noise=0.1), renders(2, noise=0.1))
    assert values[exports.OVER] < 1 and values[exports.NOISE] > limits.EXPORT_NOISE


def test_values_that_are_not_finite_fail(monkeypatch):
    spoilt = renders(2)
    spoilt[0, 3, 4] = np.nan
    monkeypatch.setattr(environments, "absent", lambda system: "")
    monkeypatch.setattr(exports, "drawn", lambda title: spoilt)
    monkeypatch.setattr(exports, "reference", lambda diffuse: renders(1))
    (row,) = exports.rows(FULL, "Radiance")
    assert row.verdict == "fail"


def test_what_does_not_render_is_never_a_pass(monkeypatch):
    def raising(error):
        def draw(title):
            raise error

        return draw

    monkeypatch.setattr(environments, "absent", lambda system: "the command that brings it")
    assert [row.reason for row in exports.rows(FULL, "Radiance")] == ["the command that brings it"]
    monkeypatch.setattr(environments, "absent", lambda system: "")
    assert "in the full profile only" in exports.rows(STANDARD, "Cycles")[0].reason
    for error, verdict in (
        (environments.Unable("no browser"), "not run"),
        (environments.Broken("exit code 1"), "fail"),
    ):
        monkeypatch.setattr(exports, "drawn", raising(error))
        assert [row.verdict for row in exports.rows(FULL, "Radiance")] == [verdict]


def test_the_scene_is_not_symmetric():
    """Otherwise what is mirrored or upside down would look the same: differences above what is allowed."""
    for diffuse in (True, False):
        image = exports.reference(diffuse)
        for other in (image[:, ::-1], image[:, :, ::-1], image[:, ::-1, ::-1]):
            assert exports.compared(image, other)[exports.OVER] > 2
