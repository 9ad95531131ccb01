"""`--renderer FOLDER`: a stranger's renderer in the study, ray by ray and by its images."""

import shutil

import pytest

from mi_refract.ray_sets import renderer_file
from validation import __main__ as command
from validation.run.context import PROFILES, Context
from validation.suite import per_ray, rendered_images
from validation.suite.renderers import table
from validation.suite.renderers.image_renderers import IMAGE_RENDERERS

PROGRAM = """import sys, numpy as np
rows = np.loadtxt((line for line in sys.stdin if line[0].isdigit()), delimiter=",", ndmin=2)
a, n, k = rows[:, 1:4], rows[:, 4:7], rows[:, 7:8] / rows[:, 8:9]
c = (n * a).sum(1, keepdims=True); d = 1 - k * k * (1 - c * c)
b = np.where(d < 0, 0, k * a - (k * c + np.sqrt(np.maximum(d, 0))) * n)
print("# system: mine 2.0"); print("id,bx,by,bz")
for i, (x, y, z) in zip(rows[:, 0], b.tolist()): print(f"{int(i)},{x!r},{y!r},{z!r}")
"""
TOML = """title = "Mine"
[[rays]]
title = "Mine, refract"
precision = "f64"
command = ["{python}", "program.py"]
total_internal_reflection = "zero"
"""
IMAGES = """[images]
export = "mitsuba"
command = ["{python}", "render.py", "{scene}", "{spp}", "{seed}", "{image}"]
spp = { sphere = 64 }
"""
RENDER = """import sys
scene, spp, seed, image = sys.argv[1:]
import mitsuba as mi
mi.set_variant("scalar_rgb")
mi.Bitmap(mi.render(mi.load_file(f"{scene}/scene.xml", bsdf="dielectric"), spp=int(spp), seed=int(seed))).write(image)
"""


@pytest.fixture
def joined(tmp_path):
    """`joined(toml)`: the system, in the tables for as long as the test runs."""
    before = dict(table.SYSTEMS), dict(IMAGE_RENDERERS)

    def join(toml=TOML):
        folder = tmp_path / "mine"
        folder.mkdir()
        (folder / renderer_file.NAME).write_text(toml)
        (folder / "program.py").write_text(PROGRAM)
        (folder / "render.py").write_text(RENDER)
        system = table.join(folder)
        rendered_images.join(system)
        return system

    yield join
    for now, then in zip((table.SYSTEMS, IMAGE_RENDERERS), before, strict=True):
        now.clear()
        now.update(then)


@pytest.fixture
def context(tmp_path):
    return Context(PROFILES["quick"], tmp_path, "llvm_ad_rgb", ("llvm", ""), {})


def test_its_rays_are_judged_as_everyone_s(joined, few, context):
    joined()
    (task,) = (each for each in per_ray.tasks(context) if "Mine" in each.name)
    rows = task.run()
    assert {row.case for row in rows} == set(per_ray.SETS) and {row.verdict for row in rows} == {"pass"}
    assert rows[0].replay["version"] == "mine 2.0"


def test_a_known_deviation_is_shown_and_must_be_seen(joined, few, context, tmp_path):
    toml = TOML + '[[rays.deviation]]\nregime = "grazing"\nreason = "lies flat"\n'
    system = joined(toml)
    rows = {row.case: row for row in per_ray.call_rows(system, system.calls[0], context)}
    assert (
        rows["grazing"].broken == {"not seen to deviate": 0.0}
        and "known to deviate: lies flat" in rows["grazing"].reason
    )
    program = tmp_path / "mine" / "program.py"
    program.write_text(
        PROGRAM.replace('print("# sys', 'b[np.abs(c[:, 0]) < 0.02] = a[np.abs(c[:, 0]) < 0.02]; print("# sys')
    )
    rows = {row.case: row for row in per_ray.call_rows(system, system.calls[0], context)}
    assert rows["grazing"].verdict == "pass" and rows["grazing"].values["wrong"] > 0


def test_its_images_are_compared(joined, context, monkeypatch, needs_variant):
    needs_variant("llvm_ad_rgb")
    system = joined(TOML + IMAGES)
    assert "Mine, assumed" in rendered_images.TERMS
    monkeypatch.setitem(rendered_images.SIZES, "quick", rendered_images.Size(16, 64, 1, 0.5))
    (row,) = rendered_images.pair_rows(context, system.title, "sphere")
    assert row.verdict == "pass" and row.replay["verdict"] in ("equal", "inconclusive")
    assert row.replay["spp"] == 64


@pytest.mark.parametrize(
    ("toml", "said"),
    [
        (TOML + IMAGES.replace("mitsuba", "vray"), "images.export: 'vray'; expected "),
        (TOML + IMAGES.replace("sphere", "teapot"), "images.spp, images.deviation: 'teapot'; expected sphere"),
        (TOML.replace("program.py", "{nothing}"), "command: {python} {nothing}: 'nothing'; expected {python}"),
        (
            TOML + "[install]\nmegabytes = 1\npip = ['x']\ncargo = ['x']\n",
            "install: unknown key `cargo`; expected megabytes",
        ),
    ],
)
def test_what_cannot_join_is_misuse_in_a_line(tmp_path, capsys, toml, said):
    before = dict(table.SYSTEMS)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / renderer_file.NAME).write_text(toml)
    try:
        assert command.main(["suite", "--renderer", str(tmp_path / "mine"), "--out", str(tmp_path / "out")]) == 2
    finally:
        table.SYSTEMS.clear()
        table.SYSTEMS.update(before)
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1


def test_a_name_that_is_taken_and_a_study_without_renderers(tmp_path, capsys):
    shutil.copytree(table.SYSTEMS_FOLDER / "pyglm", tmp_path / "pyglm")
    assert command.main(["suite", "--renderer", str(tmp_path / "pyglm"), "--out", str(tmp_path / "out")]) == 2
    assert "'pyglm' is already the name of a renderer" in capsys.readouterr().err
    assert command.main(["diff", "--renderer", str(tmp_path / "pyglm"), "--out", str(tmp_path / "out")]) == 2
    assert "is used by the study `suite` only" in capsys.readouterr().err
