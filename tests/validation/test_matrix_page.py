"""The matrix as a page and as JSON, from the rows of a validation."""

import json
import math

import pytest

from validation import __main__ as command
from validation.suite import matrix_page, per_ray, rendered_images
from validation.suite.renderers.system import LARGE


def ray(case, backward, title="A", precision="f32", verdict="pass", **more):
    values = {per_ray.BACKWARD: backward, "worst rad": 1e-7}
    replay = {"version": "A 1.0", "total internal reflection": "zero", "remark": "known"}
    return {
        "study": per_ray.NAME,
        "subject": title,
        "case": case,
        "setting": precision,
        "values": values,
        "verdict": verdict,
        "reason": "said",
        "replay": replay,
    } | more


def image(title, seen, scene="sphere", **more):
    values = {"mean difference": 1e-4}
    row = {"study": rendered_images.NAME, "subject": title, "case": scene, "setting": "64²", "values": values}
    return row | {"verdict": "pass", "reason": f"{seen}: why", "replay": {"verdict": seen}} | more


def test_systems_are_in_the_order_of_how_far_they_are_from_right():
    rows = [
        ray("random", 3.0, "far"),
        ray("random", 1.0, "near"),
        ray(LARGE, 900.0, "near"),
        ray("random", 0.5, "wrong", verdict="fail"),
        ray("random", 1.0, "both"),
        ray(LARGE, 2.0, "both"),
        ray("random", "inf", "none"),
    ]
    assert [each["system"] for each in matrix_page.matrix(rows)["rays"]] == ["both", "near", "far", "none", "wrong"]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([ray("random", 1.0)], "right in every set; known"),
        (
            [ray("random", 4.5), ray(LARGE, 1.0)],
            "exact only for inputs more than 4 roundings off: random (up to 4.5); known",
        ),
        ([ray("random", 1.0, verdict="fail"), ray(LARGE, 1.0)], "wrong: random; known"),
    ],
)
def test_what_a_system_gets_wrong_is_a_sentence(rows, said):
    (found,) = matrix_page.matrix(rows)["rays"]
    assert found["sentence"] == said and found["version"] == "A 1.0"


def test_an_inconclusive_image_is_no_equal_one():
    rows = [image("A", "equal"), image("B", "inconclusive"), image("C", "different", verdict="fail")]
    found = matrix_page.matrix(rows)["images"]
    assert [(each["system"], each["wrong"]) for each in found] == [("A", False), ("B", False), ("C", True)]
    assert [each["sentence"].partition(":")[0] for each in found][1:] == ["inconclusive", "different"]
    assert matrix_page.scene_cell(found[1]["scenes"]["sphere"])[1] != "pass"


@pytest.fixture
def folder(tmp_path):
    rows = [ray("random", 1.0), ray("random", math.nan, "<b>", verdict="fail"), image("R", "equal")]
    rows.append(ray("every set", 0.0, "absent", values={}, verdict="not run", reason="install it"))
    (tmp_path / "rows.json").write_text(json.dumps({"rows": rows}).replace("NaN", '"nan"'))
    return tmp_path


def test_the_command_writes_both(folder):
    words = ["renderers", "--page", str(folder / "p.html"), "--json", str(folder / "p.json"), "--out", str(folder)]
    assert command.main(words) == 0
    found = json.loads((folder / "p.json").read_text())
    assert [each["system"] for each in found["rays"]] == ["A", "<b>"] and found["schema"] == 1
    assert found["not_run"] == [{"system": "absent", "precision": "f32", "reason": "install it"}]
    page = (folder / "p.html").read_text()
    assert "&lt;b&gt;" in page and "install it" in page and "src=" not in page


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "no such file"),
        ("{", "no rows of a validation"),
        ('{"rows": [{"study": "other"}]}', "no rows of other systems"),
    ],
)
def test_without_rows_there_is_no_page(tmp_path, capsys, content, said):
    if content:
        (tmp_path / "rows.json").write_text(content)
    words = ["renderers", "--page", str(tmp_path / "p.html"), "--out", str(tmp_path)]
    assert command.main(words) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "p.html").exists()
