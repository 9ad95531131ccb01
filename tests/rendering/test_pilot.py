"""Settings that replace those of a scene, by hand or as a pilot chooses them."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from support.renders import BALL, GLASS, SCENES, pixels

from mi_refract.io.errors import CheckpointError
from mi_refract.plugins import lamp_tracing
from mi_refract.rendering.end_conditions import Limits
from mi_refract.rendering.long_render import Job, render_to_exr, resume
from mi_refract.rendering.pass_plan import plan_passes
from mi_refract.rendering.pilot import LEAST_LIGHT_PATHS, STEPS, Batch, Pilot, choose, ratio
from mi_refract.rendering.render_pass import pass_renderer
from mi_refract.rendering.render_settings import AUTO, OWN, parse_settings, settings_text, with_settings
from mi_refract.rendering.scene_bundle import pack
from mi_refract.rendering.scene_files import load_parsed, parse_scene

BALLS, GLASS_ONLY = SCENES / "balls.xml", {"res": "24"}
SPLIT = "sampler=multijitter,integrator=refract_path,split_depth=1"

# The choice, from figures ---------------------------------------------------------------------------------------------


def made_up(costs, own=None, noise=0.1, light=1.0, seconds=1e9, start=None):
    """A pilot whose candidates have variances and times by the text of their settings; else 1 and 1."""
    asked = []

    def measure(settings, number):
        asked.append((settings_text(settings), number))
        variance, time = costs.get(settings_text(settings), (1, 1))
        size = 100 * 2**number
        found = variance * (1 + noise * np.random.default_rng([number, *settings_text(settings).encode()]).random(size))
        return Batch(found, light, time, time * size)

    own = own or {"sampler": "independent", "integrator": "path"}
    methods = {"usable": lambda option: True, "measure": measure, "allowed": lambda t: seconds}
    parsed = SimpleNamespace(path="made-up.xml")
    return SimpleNamespace(own=own, start=start or {}, asked=asked, parsed=parsed, **methods)


CHOICES = {
    "all are alike": ({}, None, OWN),
    "a sampler": ({"sampler=orthogonal": (0.5, 1.2)}, None, "sampler=orthogonal"),
    "less noise, but slower": ({"sampler=orthogonal": (0.5, 2.2)}, None, OWN),
    "splitting, with the sampler that is best without": (
        {"sampler=ldsampler": (0.7, 1), "sampler=ldsampler,integrator=refract_path,split_depth=2": (0.1, 2)},
        None,
        "sampler=ldsampler,integrator=refract_path,split_depth=2",
    ),
    "less splitting": (
        {"split_depth=1": (0.5, 0.5)},
        {"sampler": "multijitter", "integrator": "refract_path", "split_depth": "3"},
        "split_depth=1",
    ),
    "caustics, then splitting": (
        {
            "sampler=multijitter,integrator=refract_path,caustics=lamp": (0.01, 3),
            "sampler=multijitter,integrator=refract_path,split_depth=2,caustics=lamp": (0.003, 4),
        },
        None,
        "sampler=multijitter,integrator=refract_path,split_depth=2,caustics=lamp",
    ),
    "no noise": ({OWN: (0, 1), "sampler=ldsampler": (1e-20, 1)}, None, OWN),
}


@pytest.mark.parametrize("costs, own, expected", CHOICES.values(), ids=CHOICES)
def test_the_cheapest_is_chosen_unless_it_cannot_be_told_from_the_scenes_own(costs, own, expected):
    choice = choose(made_up(costs, own))
    assert settings_text(choice.settings) == expected
    cost = choice.figures["costs"][expected]
    assert cost["low"] <= cost["value"] <= cost["high"] and cost["value"] == pytest.approx(
        cost["variance"] * cost["time"], rel=0.01
    )
    if expected != OWN:
        assert cost["high"] < 1


def test_light_that_is_missing_is_traced_whatever_it_costs():
    lamp = "integrator=refract_path,caustics=lamp"
    pilot = made_up({f"sampler=stratified,{lamp}": (0.5, 1), OWN: (0.1, 1)}, start=parse_settings(lamp))
    text = settings_text(choose(pilot).settings)
    assert text == f"sampler=stratified,{lamp}" and (OWN, 0) not in pilot.asked
    assert settings_text(parse_settings(text)) == text  # else a checkpoint would refuse the printed settings


@pytest.mark.parametrize(
    ("light", "caustics", "chosen"), [(0.8, 0.2, True), (0.99, 0.2, False), (0.992, 0.008, False), (0.99, 0.05, True)]
)
def test_lamps_are_traced_where_path_tracing_has_not_met_their_light(light, caustics, chosen):
    """Then its noise is not known. `caustics`: what the pixels of the pilot have of 0.2, or of 0.008, of the image."""
    lamp = "sampler=multijitter,integrator=refract_path,caustics=lamp"
    pilot = made_up({lamp: (5, 5)})
    measure, everywhere = pilot.measure, 0.008 if caustics == 0.008 else 0.2

    def measured(settings, number):
        if "caustics" in settings:
            return replace(measure(settings, number), light=1.0, caustics=caustics, all_caustics=everywhere)
        return replace(measure(settings, number), light=light)

    pilot.measure = measured
    assert ("caustics" in choose(pilot).settings) == chosen


def test_a_candidate_that_cannot_win_is_dropped_after_one_batch_and_seconds_end_the_pilot():
    pilot = made_up({"sampler=stratified": (10, 1)})
    choose(pilot)
    assert pilot.asked.count(("sampler=stratified", 0)) == 1 and ("sampler=stratified", 1) not in pilot.asked
    assert (OWN, 1) in pilot.asked and len(pilot.asked) == len(set(pilot.asked))  # nothing is measured twice
    short = made_up({}, seconds=1)
    choose(short)
    assert {number for _, number in short.asked} == {0}
    assert len(short.asked) == sum(map(len, STEPS)) - 1  # the scene's own are in two steps


def test_the_interval_holds_the_ratio_as_often_as_it_says():
    """95 % of a normal distribution; the time is exact here, and its share of the interval is small."""
    inside, rng = 0, np.random.default_rng(1)
    for _ in range(400):
        scale = rng.exponential(size=500)  # of a pixel, in both
        a, b = ([Batch(scale * factor * rng.chisquare(1, 500), 1.0, 1.0, 1.0)] for factor in (0.5, 1))
        found = ratio(a, b)
        inside += found.low <= 0.5 <= found.high
        assert found.time == 1 and found.low < found.value < found.high
    assert 0.9 < inside / 400 <= 1
    assert ratio(a, a).value == 1
    assert ratio([Batch(np.full(500, math.nan), 1.0, 1.0, 1.0)], b).high == math.inf


def test_a_pilot_without_light_is_an_error():
    with pytest.raises(ValueError, match="auto: the pilot sees no light; expected"):
        choose(made_up({}, light=0.0))


# Settings by hand -----------------------------------------------------------------------------------------------------

BAD = {
    "nothing": ("", "''; expected auto, or sampler=…, integrator=…, split_depth=…"),
    "an unknown name": ("smapler=independent", "expected auto, or sampler=…"),
    "auto and more": ("auto,split_depth=1", "'auto'; expected"),
    "an unknown sampler": ("sampler=sobol", "sampler = 'sobol'; expected multijitter, stratified"),
    "an unknown integrator": ("integrator=volpath", "integrator = 'volpath'; expected path, refract_path"),
    "no depth": ("split_depth=", "split_depth = ''; expected 0 to 64"),
    "a negative depth": ("split_depth=-1", "split_depth = '-1'; expected 0 to 64"),
    "a space": ("sampler= independent", "sampler = ' independent'"),
    "twice": ("split_depth=1,split_depth=2", "split_depth is given twice; expected once"),
    "path that splits": ("split_depth=1", "`path` has no split_depth; expected integrator=refract_path"),
    "too deep": ("integrator=refract_path,split_depth=65", "split_depth = '65'; expected 0 to 64"),
}


@pytest.mark.usefixtures("scalar_variant")
@pytest.mark.parametrize("text, message", BAD.values(), ids=BAD)
def test_settings_that_are_wrong(tmp_path, text, message):
    with pytest.raises(ValueError) as error:
        resume(Job(BALL, settings=text), tmp_path / "a.exr")
    assert message in str(error.value) and "\n" not in str(error.value) and not [*tmp_path.iterdir()]


@pytest.mark.usefixtures("scalar_variant")
def test_settings_replace_plugins_and_keep_what_both_have():
    parsed = parse_scene(BALL, {"res": "8", "max_depth": "7"})
    assert with_settings(parsed, {}) is parsed
    scene = load_parsed(with_settings(parsed, parse_settings(SPLIT)))
    sampler, integrator = scene.sensors()[0].sampler(), scene.integrator()
    assert "Multijitter" in str(sampler) and sampler.sample_count() == 64
    assert (integrator.split_depth, integrator.max_depth, integrator.rr_depth) == (1, 7, 7)
    ours = parse_scene(BALL, {"integrator": "refract_path"})
    assert load_parsed(with_settings(ours, {"integrator": "path"})).integrator().class_name() == "PathIntegrator"
    with pytest.raises(ValueError, match="integrator is volpath; expected `path` or `refract_path`"):
        with_settings(parse_scene(BALL, {"integrator": "volpath"}), {"integrator": "path"})


@pytest.mark.usefixtures("scalar_variant")
def test_a_sampler_comes_to_a_sensor_that_has_none_and_keeps_its_own_parameters(tmp_path):
    (tmp_path / "a.xml").write_text(
        '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"/></scene>'
    )
    parsed = with_settings(parse_scene(tmp_path / "a.xml"), {"sampler": "stratified"})
    assert "Stratified" in str(load_parsed(parsed).sensors()[0].sampler())
    own = '<sampler type="multijitter"><boolean name="jitter" value="false"/></sampler>'
    (tmp_path / "a.xml").write_text(GLASS.replace('<sampler type="independent">', own[:-10] + "<!-- -->"))
    for name, jitter in {"multijitter": False, "stratified": True}.items():
        parsed = with_settings(parse_scene(tmp_path / "a.xml"), {"sampler": name})
        text = str(load_parsed(parsed).sensors()[0].sampler())
        assert f"jitter = {int(jitter)}" in text


@pytest.mark.usefixtures("scalar_variant")
def test_scenes_that_a_pilot_cannot_measure(tmp_path):
    with pytest.raises(ValueError, match=r"samples cannot be rendered one by one; expected .* llvm_ad_rgb"):
        resume(Job(BALL, {"res": "8"}, settings=AUTO), tmp_path / "a.exr")
    assert not [*tmp_path.iterdir()]


# A pilot of a scene ---------------------------------------------------------------------------------------------------


def header_and_bits(output, **named):
    header = render_to_exr(BALLS, output, defines=GLASS_ONLY, **named)
    return header, pixels(output)


def test_the_choice_is_repeated_by_hand_bit_for_bit_kept_and_where_only_glass_makes_noise_splits(tmp_path, llvm):
    """There splitting has a hundredth of the variance."""
    header, chosen = header_and_bits(tmp_path / "a.exr", spp=16, settings=AUTO)
    settings = header["mi_refract:settings"]
    assert "integrator=refract_path,split_depth=" in settings and not settings.endswith("=0")
    figures = json.loads(header["mi_refract:identity"])["pilot"]
    assert figures["costs"][settings]["value"] < 0.5 and figures["costs"][OWN]["value"] == 1
    by_hand, bits = header_and_bits(tmp_path / "b.exr", spp=16, settings=settings)
    np.testing.assert_array_equal(bits, chosen)
    assert by_hand["mi_refract:settings"] == settings and "pilot" not in json.loads(by_hand["mi_refract:identity"])
    # The finished image is refined with the settings that it has; a plain render replaces it.
    again = resume(Job(BALLS, GLASS_ONLY, settings=AUTO), tmp_path / "a.exr", Limits(spp=16))
    assert again.end() == "16 spp" and again.pilot_lines()[-1].endswith(f"has chosen --settings {settings}")
    assert resume(Job(BALLS, GLASS_ONLY), tmp_path / "a.exr", Limits(spp=16)).progress.passes == 0
    # Workers are sent the scene with its settings.
    assert pack(again.parsed).nodes == with_settings(parse_scene(BALLS, GLASS_ONLY), parse_settings(settings)).nodes


def test_a_checkpoint_keeps_the_choice(tmp_path, llvm):
    class Stop(Exception):
        pass

    def stop(render):
        raise Stop

    def begun(settings, restart=False):
        limits = Limits(spp=32, pass_spp=16)
        return resume(Job(BALLS, GLASS_ONLY, settings=settings), tmp_path / "a.exr", limits, restart=restart)

    with pytest.raises(Stop):
        begun(AUTO).run(stop)
    resumed = begun(AUTO)
    assert resumed.progress.passes == 1
    settings = resumed.progress.identity["settings"]
    assert settings != OWN and begun(settings).progress.passes == 1
    for other in (OWN, "sampler=ldsampler"):
        with pytest.raises(CheckpointError, match=f"settings was {settings}, is {other}; pass --restart"):
            begun(other)
    resumed.run()
    bits = pixels(tmp_path / "a.exr")
    begun(settings, restart=True).run()
    np.testing.assert_array_equal(pixels(tmp_path / "a.exr"), bits)
    with pytest.raises(Stop):
        begun(OWN, restart=True).run(stop)
    with pytest.raises(CheckpointError, match=f"settings was {OWN}, is auto; pass --restart"):
        begun(AUTO)


def test_the_time_of_light_paths_has_no_compilation_in_it(tmp_path, llvm, monkeypatch):
    """The second trace compiles again where Dr.Jit's cache of kernels is empty."""
    lamp = '<shape type="rectangle"><emitter type="area"/></shape>'
    (tmp_path / "a.xml").write_text(GLASS.replace('<emitter type="constant"/>', lamp))
    parsed, took = parse_scene(tmp_path / "a.xml"), []
    renderer = pass_renderer(load_parsed(parsed), 0)

    def trace(*args, **named):
        took.append(100 if len(took) < 2 else 1)
        return 2 * (np.zeros((*renderer.size[::-1], 3)),)

    monkeypatch.setattr(lamp_tracing, "lamp_image", trace)
    pixel_count = math.prod(renderer.size)
    pilot = Pilot(parsed, renderer, lambda rounded: plan_passes(pixel_count, 16, None, rounded, moments=True))
    pilot.clock = lambda: sum(took)
    batch = pilot.measure({"integrator": "refract_path", "caustics": "lamp"}, 0)
    assert 0 < batch.seconds < 2 * 0.25 * 16 / LEAST_LIGHT_PATHS


DARK = GLASS.replace('<emitter type="constant"/>', "")
CANNOT = {
    "no light": (DARK, {}, "auto: the pilot sees no light; expected some"),
    "a film with a border": (
        GLASS.replace("</film>", '<boolean name="sample_border" value="true"/></film>'),
        {},
        "samples cannot be rendered one by one; expected an integrator of samples, a film without a border",
    ),
}


@pytest.mark.parametrize("text, named, message", CANNOT.values(), ids=CANNOT)
def test_what_a_pilot_cannot_choose_for_is_an_error_and_nothing_is_written(tmp_path, llvm, text, named, message):
    (tmp_path / "a.xml").write_text(text)
    with pytest.raises(ValueError) as error:
        resume(Job(tmp_path / "a.xml", settings=AUTO), tmp_path / "a.exr", Limits(**named))
    assert (
        message in str(error.value) and "\n" not in str(error.value) and [*tmp_path.iterdir()] == [tmp_path / "a.xml"]
    )


def test_a_sampler_that_is_not_mitsubas_is_an_error(tmp_path, llvm):
    class Fixed(mi.Sampler):
        pass

    mi.register_sampler("fixed", Fixed)
    (tmp_path / "a.xml").write_text(GLASS.replace('sampler type="independent"', 'sampler type="fixed"'))
    job = Job(tmp_path / "a.xml", allow_plugins=["fixed"], settings=AUTO)
    with pytest.raises(
        ValueError, match=r"the scene's sampler is fixed; expected multijitter, .*, or settings by name"
    ):
        resume(job, tmp_path / "a.exr", Limits(spp=4, pass_spp=4))


def test_a_scene_with_another_integrator_keeps_it(tmp_path, llvm):
    (tmp_path / "a.xml").write_text(re.sub("<integrator.*/integrator>", '<integrator type="depth"/>', GLASS))
    render = resume(Job(tmp_path / "a.xml", settings=AUTO), tmp_path / "a.exr", Limits(spp=4))
    costs = render.progress.identity["pilot"]["costs"]
    assert len(costs) == len(STEPS[0]) and not any("integrator" in name for name in costs)
