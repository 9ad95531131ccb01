"""Garbage in, kills and full disks: the studies' own small runs, and that they see planted defects."""

import json
import random
import subprocess
import sys

import pytest
from support import processes

from mi_refract.plugins import scene_parser
from validation.robustness import mutate, mutated_inputs, parsers, scene_inputs

INPUTS = 650


def test_garbage_is_answered_in_one_line_by_every_parser(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", processes.ENVIRONMENT["PYTHONPATH"])
    counts, findings = mutated_inputs.fuzz(INPUTS)
    assert findings == []
    assert len(counts) == 13
    assert all(found.total() == INPUTS / 13 and found["refused"] > 0 for found in counts.values())
    assert counts["answers, CSV"]["read"] > 0 and "rays, CSV" in counts


@pytest.mark.usefixtures("scalar_variant")
def test_the_good_inputs_are_good(tmp_path):
    for name, parser in parsers.parsers(tmp_path).items():
        for content in parser.good:
            path = tmp_path / f"mutated{parser.suffix}"
            path.write_bytes(content)
            assert parser.read(path) == "", name


BAIT = b'<bsdf type="checkerboard"><bsdf type="near_clip"/></bsdf></scene>'
# What lets it through: the module, what of it is replaced, and by what; and what the study says then.
LET_THROUGH = {
    "plugin": (
        "scene, XML",
        b"</scene>",
        BAIT,
        scene_parser,
        "check_plugins",
        "a plugin of the scene's own was opened",
    ),
    "vertex": ("mesh, PLY", b"3 0 3 4", b"3 0 3 6", scene_parser, "check_faces", "a face without its vertices"),
}


@pytest.mark.usefixtures("scalar_variant")
@pytest.mark.parametrize("case", LET_THROUGH)
def test_what_a_scene_must_not_do_is_refused_and_would_be_seen(case, tmp_path, monkeypatch):
    name, old, new, module, check, message = LET_THROUGH[case]
    flat = '<boolean name="face_normals" value="true"/></shape>'  # without it memory would be overwritten
    monkeypatch.setattr(scene_inputs, "MESH", scene_inputs.MESH.replace("</shape>", flat))
    parser = parsers.parsers(tmp_path)[name]
    path = tmp_path / f"mutated{parser.suffix}"
    assert parser.good[-1].count(old) == 1
    path.write_bytes(parser.good[-1].replace(old, new))
    with pytest.raises(ValueError, match="expected "):
        parser.read(path)
    monkeypatch.setattr(module, check, lambda *arguments: None)
    assert message in parser.read(path)


@pytest.mark.parametrize("answer", ["return ''", "raise ValueError('a: b')"])
def test_what_takes_memory_is_seen(answer, tmp_path, monkeypatch):
    space = {}
    exec(f"def read(path):\n    peaks.append(peaks[-1] + 2**31 + 1)\n    {answer}", space)
    space["peaks"] = peaks = [5]
    monkeypatch.setattr(scene_inputs, "_peak", lambda: peaks[-1])
    assert scene_inputs._bounded(space["read"])(tmp_path) == "took 2147483649 bytes of memory"


def test_the_same_seed_gives_the_same_input_and_another_one_another():
    made = [mutate.mutated(parsers.SETTINGS, random.Random(f"{seed}/7")) for seed in (0, 0, 1)]
    assert made[0] == made[1] != made[2]


@pytest.mark.parametrize(
    ("does", "outcome"),
    [
        ("raise KeyError('x')", "tracebacks"),
        ("return 'garbage'", "accepted garbage"),
        ("raise ValueError('a: b')", "refused"),
        ("raise ValueError('a\\nb')", "tracebacks"),
        ("return ''", "read"),
        ("raise MemoryError", "refused"),
    ],
)
def test_what_counts_as_a_finding(does, outcome, tmp_path):
    space = {}
    exec(f"def read(path):\n    {does}", space)
    assert mutated_inputs._outcome(space["read"], tmp_path)[0] == outcome


DEATHS = """
import os, sys, time, types
from validation.robustness import mutated_inputs
mutated_inputs.HANG = 0.3
start = int(sys.argv[1])
made = []
def read(path):
    if path.read_bytes() == b"die":
        os.kill(os.getpid(), 11)
    if path.read_bytes() == b"hang":
        time.sleep(60)
def mutation(rng):
    made.append(0)
    return {3: b"die", 5: b"hang"}.get(start + len(made) - 1, b"")
parser = types.SimpleNamespace(suffix=".x", read=read, mutation=mutation)
sys.modules["validation.robustness.parsers"] = types.SimpleNamespace(parsers=lambda folder: {"p": parser})
mutated_inputs._child(0, start, 8)
"""


def test_a_hang_and_a_death_are_findings_and_the_rest_is_read(monkeypatch):
    run = subprocess.run

    def child(command, **how):
        return run([sys.executable, "-c", DEATHS, command[-2]], env=processes.ENVIRONMENT, **how)

    monkeypatch.setattr(mutated_inputs.subprocess, "run", child)
    counts, findings = mutated_inputs.fuzz(8)
    assert [each["input"] for each in findings] == [3, 5]
    assert {each["outcome"] for each in findings} == {"hangs or deaths"}
    assert counts["p"]["read"] == 6


@pytest.mark.parametrize("kills, commands", [(3, ["accept", "diff --report", "validation"]), (1, ["render"])])
def test_killed_commands_leave_whole_files_and_end_well_when_started_again(kills, commands):
    words = [sys.executable, "-m", "validation.robustness.killed_commands", str(kills), *commands]
    done = subprocess.run(words, env=processes.ENVIRONMENT, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert [*rows] == commands
    for values in rows.values():
        assert values == {"kills": kills, "torn files": 0, "wrong ends": 0, "bad restarts": 0}
