"""Scale on a cluster: the model by hand, the simulation in cases that are known, and the rows of the study."""

import dataclasses

import pytest

from mi_refract.rendering import cluster_passes
from mi_refract.rendering.cluster_passes import ClusterPasses
from validation.efficiency import cluster_model, cluster_processes, cluster_scale, cluster_simulation
from validation.efficiency.cluster_model import PRESENT, RELAYED, SCHEMES, Costs, Scheme, asked, predict

SLOW = Costs(fixed=10.0)  # passes that are single tasks; all else is free


def test_the_model_by_hand():
    """16 passes on 4 workers, of 10 s: nodes 0, 1 … 7 and 8–15, as the first 12 are asked for singly and 12–15 too."""
    costs = Costs(10, 0, 0.5, 0.25, 100, 50, 0.001, 0.0005, 0.01, 0.0025, 0.125, 0.2, 3, begin=7)
    assert list(asked(16, 10, 4)) == [(0, 0)] * 16
    found = predict(16, 1, 4, costs, Scheme("both", listed=True, relayed=True))
    assert found.parts == pytest.approx(
        {
            "workers": 4 * 10,
            "links": 0,
            "scheduler": 16 * (0.001 + 4 * 0.0005) + 16 * 0.2,
            "client": 16 * (0.01 + 4 * 0.0025) + 16 * (3 + 0.5 + 0.25 + 0.125 * 16),
        }
    )
    assert (found.begin, found.end) == pytest.approx((7, 3 + 0.5 + 0.25))
    assert found.efficiency == pytest.approx(160 / (4 * (7 + found.parts["client"] + 3.75)))
    assert found.limit == "the client"


def test_the_model_by_hand_with_folds():
    """64 passes on 8 workers, whole nodes first: 0, 1 … 7 up to the stop at 8, then nodes of 8 where they fit."""
    costs = Costs(10, 0, 0.5, 0.25, 100, 50, 0.001, 9.0, 0.01, 9.0, 0.125, 9.0, 9.0, begin=7)
    nodes = list(asked(64, 10, 8))
    singles, eights = nodes.count((0, 0)), nodes.count((0, 1))
    assert (singles, eights) == (8 + 8, 6)  # 8–11 and 12–15 end at stops, too
    found = predict(64, 1, 8, costs, PRESENT)
    assert found.parts == pytest.approx(
        {
            "workers": 8 * 10 + 6 * (0.5 + 7 * 0.25) / 8,
            "links": 6 * 7 * 2 / 8,
            "scheduler": 70 * 0.001,
            "client": 70 * 0.01 + 22 * (2 + 0.5 + 0.25 + 0.125 * 22),
        }
    )
    assert found.end == pytest.approx(7 * 2 + 0.5 + 7 * 0.25 + 2 + 0.5 + 0.25)


def test_the_models_levels_are_those_of_the_client():
    """Of passes from 1 ms to 100 s on 1 to 10,000 workers."""
    for seconds in (0.001, 0.04, 0.3, 0.4, 2.0, 100.0):
        for workers in (1, 7, 100, 10_000):
            world = cluster_simulation.World(workers, Costs(), 1)
            source = cluster_simulation.SimulatedPasses(world)
            source._pass_seconds.append(seconds)
            assert ClusterPasses.levels(source) == cluster_model.levels(seconds, workers)


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda scheme: scheme.name)
@pytest.mark.parametrize("passes", [1, 8, 100])
def test_one_worker_that_only_renders_is_efficient(scheme, passes):
    assert cluster_simulation.efficiency(passes, 1, 1, SLOW, scheme) == pytest.approx(1)
    assert predict(passes, 1, 1, SLOW, scheme).efficiency == pytest.approx(1)


@pytest.mark.parametrize(("passes", "workers"), [(64, 8), (100, 7), (5, 8), (512, 100)])
def test_with_infinite_bandwidth_only_granularity_is_lost(passes, workers):
    expected = passes / workers / -(-passes // workers)
    for scheme in SCHEMES:
        assert cluster_simulation.efficiency(passes, 1, workers, SLOW, scheme) == pytest.approx(expected)
        assert predict(passes, 1, workers, SLOW, scheme).efficiency == pytest.approx(expected)


def test_a_scheduler_that_is_the_limit_takes_its_time_for_every_task():
    """Passes that take no time beside it; the last message and the first come alone, and the client polls."""
    costs = Costs(fixed=1e-3, task=1.0)
    took, model = cluster_simulation.simulate(512, 1, 50, costs), predict(512, 1, 50, costs)
    tasks = model.parts["scheduler"]
    assert model.limit == "the scheduler" and model.seconds == pytest.approx(tasks)
    assert tasks <= took <= 1.05 * tasks + 2


def test_a_client_that_is_the_limit_takes_its_time_for_every_node():
    costs = Costs(fixed=10.0, relay=1e-9, receive=5.0)
    took, model = cluster_simulation.simulate(96, 1, 7, costs, RELAYED), predict(96, 1, 7, costs, RELAYED)
    assert model.limit == "the client"
    assert took == pytest.approx(10 + 96 * 5.0)


def test_links_that_are_the_limit_are_seen_by_the_simulation():
    """A node takes as long as a pass: 7 of 8 go to another worker, so a worker sends and takes less than it renders."""
    costs = dataclasses.replace(SLOW, node_bytes=1.0, bandwidth=1 / 400.0)
    took, model = cluster_simulation.simulate(512, 1, 64, costs, PRESENT), predict(512, 1, 64, costs, PRESENT)
    assert took >= model.parts["links"] >= 512 / 64 * 10


def test_the_simulation_never_beats_the_model_by_more_than_its_end():
    """The model is a bound, but for its end, of which some happens beside the last passes."""
    costs = Costs(0.3, 0.9, 0.02, 0.03, 1e8, 1e9, 1.5e-3, 4e-6, 9e-4, 4e-7, 3e-8, 0.13, 1.1, begin=0.7)
    for scheme in SCHEMES:
        for workers in (1, 10, 100):
            took, model = (
                cluster_simulation.simulate(512, 8, workers, costs, scheme),
                predict(512, 8, workers, costs, scheme),
            )
            assert model.seconds - model.end <= took * (1 + 1e-9)


def test_the_best_pass_is_the_one_that_ends_first():
    spp, best = cluster_scale.best_pass(100, Costs(fixed=1.0, sample=0.1, begin=1.0), PRESENT)
    others = [cluster_scale.predicted(1 << k, 100, Costs(fixed=1.0, sample=0.1, begin=1.0), PRESENT) for k in range(10)]
    assert best.seconds == min(each.seconds for each in others) and 1 < spp < 512


def test_a_goal_that_is_missed_is_shown_and_fails_nothing():
    row = cluster_scale.simulated_row("sphere", PRESENT, cluster_scale.GOAL, Costs(fixed=1.0, begin=9.0), 64)
    assert row.missed and row.verdict == "info"
    row = cluster_scale.simulated_row("sphere", PRESENT, 10, Costs(fixed=1.0), 64)
    assert not row.goals and row.values["efficiency"] == pytest.approx(row.values["model"], rel=0.05)


def test_processes_that_sleep_give_the_sums_of_all_passes():
    before = cluster_passes.render_node
    found = cluster_processes.measured(2, 16, 0.02)
    assert 0 < found["efficiency"] <= 1 and cluster_passes.render_node is before
