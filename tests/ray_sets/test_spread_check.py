"""A set that is judged in pieces, here or on workers, has the findings of one that is judged whole."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support import ray_programs as programs

from mi_refract import oracle
from mi_refract.cli.app import main
from mi_refract.ray_sets import check_answers, files, judged_parts, pieces, ray_set, reports, spread_check
from mi_refract.ray_sets.ray_set import Answers
from mi_refract.report.row import strict

NAMES = ("generic", "critical", "grazing")


@pytest.fixture(scope="module")
def rays():
    return ray_set.make(NAMES, 150)


@pytest.fixture(scope="module")
def right(rays):
    exact = oracle.refract(rays.rays.a, rays.rays.n, rays.rays.k, fresnel=False, progress=False)
    return np.where(exact.transmitted[:, None], exact.direction, 0).astype(np.float32).astype(float)


CHANGES = {
    "right": lambda b: b,
    "reversed": lambda b: -b,
    "few digits": lambda b: np.round(b, 3),
    "length": lambda b: 1.01 * b,
    "every fifth": lambda b: b * np.where(np.arange(len(b)) % 5, 1, -1)[:, None],
    "unclear": lambda b: np.where(np.arange(len(b))[:, None] % 2 & ~b.any(1, keepdims=True), np.nan, b),
}


def shown(rays, b, judge=judged_parts.here):
    found = check_answers.check(rays, Answers(rays.ids, b), judge=judge)
    return json.dumps(strict(reports.as_data(found)))


def backwards(calls):
    """A judge whose last piece is the first to be ready."""
    return reversed(list(judged_parts.here(calls)))


@pytest.mark.parametrize("change", CHANGES)
def test_findings_do_not_depend_on_the_pieces(rays, right, change, monkeypatch):
    b = CHANGES[change](right)
    whole = shown(rays, b)
    for rays_of_piece in (7, 64):
        monkeypatch.setattr(pieces, "PIECE", rays_of_piece)
        assert shown(rays, b, backwards) == whole


def test_ids_of_a_problem_are_the_first_of_all_pieces(rays, right, monkeypatch):
    monkeypatch.setattr(pieces, "PIECE", 8)
    b = right.copy()
    b[[3, 7, 160, 170, 180, 190, 200]] = np.inf
    problems = check_answers.check(rays, Answers(rays.ids, b)).problems
    assert [(each.kind, each.count, each.text) for each in problems] == [
        ("non-finite", 7, "ids 3, 7, 160, 170, 180, …")
    ]


def test_a_signal_that_was_guessed_wrong_is_found(rays, right, monkeypatch):
    whole = shown(rays, right)
    asked = []

    def judge(calls):
        for number, (piece, question) in enumerate(calls):
            asked.append(question.tir)
            yield number, judged_parts.judge_part(piece, question)

    monkeypatch.setattr(check_answers, "_guess", lambda given, question: "nan")
    assert shown(rays, right, judge) == whole
    assert asked == ["nan"] * 3 + ["zero"] * 3


def test_the_last_of_the_largest_ranks():
    assert judged_parts.last_of_largest([(0, 0, 0, 1.0), (0, 1, 0, 0.5), (0, 1, 0, 0.5), (0, 0, 1, 9.0)]) == 2
    assert judged_parts.last_of_largest([(0, 0, 0, np.nan), (0, 0, 0, 5.0)]) == 0


def test_workers_give_the_same_files(tmp_path, capsys, monkeypatch):
    rays = ray_set.make(("generic", "critical"), 40)
    b = programs.glsl(rays.rays.a, rays.rays.n, 1 / rays.rays.k)
    files.write(tmp_path / "rays.npz", rays)
    np.savez(tmp_path / "answers.npz", id=rays.ids, b=b)
    asked = ["rays", "check", str(tmp_path / "answers.npz"), "--rays", str(tmp_path / "rays.npz")]
    said, names = [], ("json", "junit")
    for folder, more in (("here", []), ("there", ["--workers", "1"])):
        (tmp_path / folder).mkdir()
        out = [tmp_path / folder / f"x.{end}" for end in ("json", "xml")]
        words = [word for name, path in zip(names, out, strict=True) for word in (f"--{name}", str(path))]
        code = main([*asked, *words, *more])
        said.append((code, capsys.readouterr().out, *(path.read_bytes() for path in out)))
    assert said[0] == said[1] and said[0][0] == 1


def test_facts_name_what_findings_depend_on():
    assert set(spread_check.PACKAGES) < spread_check.facts("scalar_rgb").keys()
    assert "unknown" not in spread_check.facts("scalar_rgb").values()


@pytest.mark.parametrize(
    "options, message",
    [
        (("--scheduler", "tcp://h:1", "--workers", "2"), "--scheduler and --workers; expected one of them"),
    ],
)
def test_options_of_a_cluster_that_are_misuse(capsys, options, message):
    assert main(["rays", "check", "a.csv", *options]) == 2
    assert message in capsys.readouterr().err
