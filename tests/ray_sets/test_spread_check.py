"""A set that is certified in pieces, here or on workers, has the findings of one that is certified whole."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support import ray_programs as programs

from mi_refract.cli.app import main
from mi_refract.ray_sets import check_answers, files, matched_answers, ray_set, reports, spread_check
from mi_refract.ray_sets.ray_set import Answers

NAMES, COUNT = ("generic", "critical", "grazing"), 50
TOTAL = len(NAMES) * COUNT
CHANGES = {
    "right": lambda b: b,
    "reversed": lambda b: -b,
    "few digits": lambda b: np.round(b, 3),
    "length": lambda b: 1.01 * b,
    "every fifth": lambda b: b * np.where(np.arange(TOTAL) % 5, 1, -1)[:, None],
    "unclear": lambda b: np.where(np.arange(TOTAL)[:, None] % 2 & ~b.any(1, keepdims=True), np.nan, b),
    "no direction, the last": lambda b: np.where(np.arange(TOTAL)[:, None] == TOTAL - 1, np.inf, b),
}


def backwards(pieces):
    """The last piece is certified first."""
    return reversed(list(check_answers.certify_here(pieces)))


@pytest.mark.parametrize("change", CHANGES)
def test_findings_do_not_depend_on_the_pieces(change, monkeypatch):
    rays = ray_set.make(NAMES, COUNT)
    b = CHANGES[change](programs.glsl(rays.rays.a, rays.rays.n, rays.rays.k).astype(float))
    order = np.random.default_rng(1).permutation(TOTAL)[3:]
    for answers in (Answers(rays.ids, b), Answers(order, b[order])):
        whole = repr(reports.as_data(check_answers.check(rays, answers)))
        for size in (7, 64):
            monkeypatch.setattr(matched_answers, "PIECE", size)
            assert repr(reports.as_data(check_answers.check(rays, answers, certify=backwards))) == whole
        monkeypatch.undo()


@pytest.mark.parametrize("seed", range(10))
def test_the_first_answer_to_a_ray_counts(seed):
    rng = np.random.default_rng(seed)
    rays = ray_set.make(("generic",), int(rng.integers(1, 60)))
    ids = rng.integers(-9 if seed % 2 else 0, len(rays) + 9, int(rng.integers(0, 130)))
    b, flags, ratios = rng.normal(size=(len(ids), 3)), rng.integers(0, 2, len(ids)) == 1, rng.uniform(0.5, 2, len(ids))
    matched, mismatches = matched_answers.match(rays, Answers(ids, b, flags, n_ratio=ratios))
    said = ids.tolist()
    assert matched.ids.tolist() == [i for i in range(len(rays)) if i in said]
    assert {kind: list(found) for kind, found in mismatches.items()} == {
        "missing": [i for i in range(len(rays)) if i not in said],
        "duplicate": sorted({i for i in said if said.count(i) > 1}),
        "unknown": sorted({i for i in said if not 0 <= i < len(rays)}),
    }
    first = [said.index(i) for i in matched.ids]
    for piece in matched.pieces():
        for name, column in {"b": b, "transmitted": flags, "n_ratio": ratios}.items():
            np.testing.assert_array_equal(getattr(piece, name), column[first])


def test_workers_give_the_same_files(tmp_path, capsys):
    rays = ray_set.make(("generic", "critical"), 40)
    files.write(tmp_path / "rays.npz", rays)
    np.savez(tmp_path / "answers.npz", id=rays.ids, b=programs.glsl(rays.rays.a, rays.rays.n, 1 / rays.rays.k))
    said = []
    for more in ([], ["--workers", "1"]):
        out = [tmp_path / f"{len(more)}.{end}" for end in ("json", "xml")]
        words = ["--json", str(out[0]), "--junit", str(out[1]), "--rays", str(tmp_path / "rays.npz"), *more]
        code = main(["rays", "check", str(tmp_path / "answers.npz"), *words])
        said.append((code, capsys.readouterr().out, *(path.read_bytes() for path in out)))
    assert said[0] == said[1] and said[0][0] == 1


def test_what_workers_send_back_is_small():
    rays = ray_set.make(("generic",), 100).rays
    exact = check_answers.certified(rays)
    assert sum(getattr(exact, each.name).nbytes for each in dataclasses.fields(exact)) < 100 * 80


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
