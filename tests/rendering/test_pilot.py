"""Settings that replace those of a scene: given by the user, or chosen by a pilot."""

from __future__ import annotations

import itertools
import json
import math
import re
import time
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from support.renders import BALL, GLASS, SCENES, pixels, stopped_after

from mi_refract.io.errors import CheckpointError
from mi_refract.plugins import lamp_tracing
from mi_refract.rendering import long_render
from mi_refract.rendering.end_conditions import Limits
from mi_refract.rendering.long_render import Job, render_to_exr, resume
from mi_refract.rendering.pass_plan import plan_passes
from mi_refract.rendering.pilot import LIGHT_PATHS, Choice, Passes, Pilot, choose, ratios
from mi_refract.rendering.render_pass import pass_renderer
from mi_refract.rendering.render_settings import AUTO, OWN, parse_settings, settings_text, with_settings
from mi_refract.rendering.scene_bundle import pack
from mi_refract.rendering.scene_files import load_parsed, parse_scene

BALLS, GLASS_ONLY = SCENES / "balls.xml", {"res": "24"}
SPLIT = "sampler=multijitter,integrator=refract_path,split_depth=1"

# The choice, from made-up measurements --------------------------------------------------------------------------------


PLAIN = "sampler=multijitter,integrator=refract_path"
DEEP = f"{PLAIN},split_depth=3"
LAMPS = f"{DEEP},caustics=lamp"


def made_up(costs, light=1.0, seconds=10_000, lamps=0.1, found=None, rare=()):
    """Return a pilot with made-up measurements.

    `costs`: variance and time of candidates, by the text of their settings; 1 and 1 for all others. `lamps`: mean light
    of lamps. `found`: returns the samples of this light that path tracing finds, for a number of pixels, channels ×
    pixels × COPIES × samples. `rare`: candidates with one bright sample in the first pixel that alone has a variance of
    10⁶.
    """
    batches = []

    def measure(settings, number, size):
        name = settings_text(settings)
        batches.append((name, number))
        variance, time = costs.get(name, (1, 1))
        means = light + math.sqrt(variance) * np.random.default_rng(number).normal(size=(1, size, 2))
        if name in rare and number == 0:
            means[:, 0, 0] += math.sqrt(2e6 * size)
        if name != LAMPS:
            return Passes(means, time)
        x = found(size)
        return Passes(means, time, 0.0, lamps, 0.0, np.stack([x.mean(-1), x.var(-1, ddof=1) / x.shape[-1]]))

    candidates = [parse_settings(text) for text in (OWN, PLAIN, DEEP, *[LAMPS] * (found is not None))]
    methods = {"measure": measure, "allowed": lambda t: seconds}
    parsed = SimpleNamespace(path="made-up.xml")
    return SimpleNamespace(candidates=candidates, first_pixels=64, batches=batches, parsed=parsed, **methods)


def finds(share, size, both=False):
    """Return a `found` with a sample of brightness `size` in one pass of a share of the pixels; `both`: in both."""

    def found(pixels):
        x = np.zeros((1, pixels, 2, 16))
        x[:, : round(share * pixels), : 2 if both else 1, 0] = size
        return x

    return found


CHOICES = {
    "all cost the same": ({}, {}, OWN),
    "a stratified sampler": ({PLAIN: (0.5, 1.2), DEEP: (0.5, 2)}, {}, PLAIN),
    "less noise, but slower": ({PLAIN: (0.5, 2.2), DEEP: (0.5, 2.2)}, {}, OWN),
    "splitting": ({PLAIN: (0.7, 1), DEEP: (0.1, 2)}, {}, DEEP),
    "splitting that hardly pays": ({PLAIN: (0.5, 1), DEEP: (0.48, 1)}, {}, PLAIN),
    "no noise": ({OWN: (0, 1), PLAIN: (0, 1), DEEP: (1e-20, 1)}, {}, OWN),
    # Rare and bright samples: candidates that have missed them seem to have less noise.
    "rare samples, only where glass is split": ({DEEP: (0.5, 3)}, {"rare": (DEEP,)}, PLAIN),
    "rare samples, missed by the scene's own": ({DEEP: (0.5, 3)}, {"rare": (DEEP, PLAIN)}, PLAIN),
    # Tracing lamps takes three times as long. The mean of their light is 0.1 unless `lamps` gives it.
    "lamps, found evenly": ({LAMPS: (1, 3)}, {"found": finds(1.0, 1.6, both=True)}, OWN),
    "lamps, found in a few bright samples": ({LAMPS: (1, 3)}, {"found": finds(1 / 64, 640)}, LAMPS),
    # Both passes of one pixel have such a sample: their difference is 0, yet there is noise.
    "lamps, found in two equal bright samples": (
        {LAMPS: (1, 3)},
        {"found": finds(1 / 64, 640, both=True), "seconds": 1000},
        LAMPS,
    ),
    "faint lamps, found": ({LAMPS: (1, 3)}, {"found": finds(1 / 64, 640), "lamps": 1e-3}, OWN),
    "lamps, not found": ({LAMPS: (1, 3)}, {"found": finds(0, 0), "lamps": 0.3}, LAMPS),
    "faint lamps, not found": ({LAMPS: (1, 3)}, {"found": finds(0, 0), "lamps": 1e-3}, OWN),
}


@pytest.mark.parametrize("costs, options, expected", CHOICES.values(), ids=CHOICES)
def test_the_cheapest_candidate_is_chosen_unless_the_scenes_own_is_similar(costs, options, expected):
    choice = choose(made_up(costs, **options))
    assert settings_text(choice.settings) == choice.figures["of"] == expected
    assert choice.figures["costs"][expected]["value"] == 1
    for cost in choice.figures["costs"].values():
        assert cost["low"] <= cost["value"] <= cost["high"]
        assert cost["value"] == pytest.approx(cost["variance"] * cost["time"], rel=0.01)


def test_the_second_batch_omits_losers_and_is_skipped_without_time():
    pilot = made_up({OWN: (100, 1)})
    choose(pilot)
    assert pilot.batches == [(OWN, 0), (PLAIN, 0), (DEEP, 0), (PLAIN, 1), (DEEP, 1)]
    # The light of lamps is measured with the candidate before, so this one is kept with them.
    pilot = made_up({OWN: (1e6, 1), DEEP: (1, 20)}, seconds=1e5, found=finds(1.0, 1.6, both=True))
    choose(pilot)
    assert pilot.batches[4:] == [(PLAIN, 1), (DEEP, 1), (LAMPS, 1)]
    short = made_up({}, seconds=64 * 2 * (3 + 1))  # enough for the three first batches and one more, not for three more
    figures = choose(short).figures
    assert figures["seconds"] == 64 * 2 * 3 and {number for _, number in short.batches} == {0}
    assert figures["share"] == pytest.approx(3 / 4 * 0.05)  # 3 of the 4 batches that take 5 % of the render


def test_the_interval_of_a_ratio_contains_it_with_95_percent():
    """For normally distributed noise. The times are exact here, and their error is a small part of the interval."""
    inside, rng = 0, np.random.default_rng(1)
    for _ in range(200):
        scale = rng.exponential(size=(1, 500, 1))  # of each pixel, for both candidates
        own, other = (Passes(factor * scale * rng.normal(size=(1, 500, 2)), 1.0) for factor in (1, 0.5))
        ratio = ratios({OWN: own, PLAIN: other}, OWN)[PLAIN]
        inside += ratio.low <= 0.25 <= ratio.high
        assert ratio.time == 1 and ratio.low < ratio.value < ratio.high
    assert 0.9 < inside / 200 <= 1
    assert ratios({OWN: own}, OWN)[OWN].value == 1
    not_finite = Passes(np.full((1, 500, 2), math.nan), 1.0)
    assert ratios({OWN: own, PLAIN: not_finite}, OWN)[PLAIN].high == math.inf


def test_a_pilot_that_sees_no_light_is_an_error():
    with pytest.raises(ValueError, match="auto: the pilot sees no light; expected"):
        choose(made_up(dict.fromkeys((OWN, PLAIN, DEEP), (0, 1)), light=0.0))


# Settings given by the user -------------------------------------------------------------------------------------------

INVALID = {
    "empty": ("", "''; expected auto, or sampler=…, integrator=…, split_depth=…"),
    "an unknown name": ("smapler=independent", "expected auto, or sampler=…"),
    "auto and another": ("auto,split_depth=1", "'auto'; expected"),
    "an unknown sampler": ("sampler=sobol", "sampler = 'sobol'; expected multijitter, orthogonal"),
    "an unknown integrator": ("integrator=volpath", "integrator = 'volpath'; expected path, refract_path"),
    "no depth": ("split_depth=", "split_depth = ''; expected 0 to 64"),
    "a negative depth": ("split_depth=-1", "split_depth = '-1'; expected 0 to 64"),
    "a space": ("sampler= independent", "sampler = ' independent'"),
    "twice": ("split_depth=1,split_depth=2", "split_depth is given twice; expected once"),
    "split depth of path": ("split_depth=1", "`path` has no split_depth; expected integrator=refract_path"),
    "too deep": ("integrator=refract_path,split_depth=65", "split_depth = '65'; expected 0 to 64"),
}


@pytest.mark.usefixtures("scalar_variant")
@pytest.mark.parametrize("text, message", INVALID.values(), ids=INVALID)
def test_invalid_settings_are_refused(tmp_path, text, message):
    with pytest.raises(ValueError) as error:
        resume(Job(BALL, settings=text), tmp_path / "a.exr")
    assert message in str(error.value) and "\n" not in str(error.value) and not [*tmp_path.iterdir()]


@pytest.mark.usefixtures("scalar_variant")
def test_settings_replace_plugins_and_keep_common_parameters():
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
def test_a_sampler_is_added_to_a_sensor_without_one(tmp_path):
    (tmp_path / "a.xml").write_text(
        '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"/></scene>'
    )
    parsed = with_settings(parse_scene(tmp_path / "a.xml"), {"sampler": "stratified"})
    assert "Stratified" in str(load_parsed(parsed).sensors()[0].sampler())


@pytest.mark.usefixtures("scalar_variant")
@pytest.mark.parametrize("first", ["shape", "sensor"])
def test_the_sampler_of_the_first_sensor_is_replaced_also_in_a_shape(tmp_path, first):
    meter = '<shape type="rectangle"><sensor type="irradiancemeter"><sampler type="independent"/></sensor></shape>'
    camera = '<sensor type="perspective"><sampler type="orthogonal"/></sensor>'
    sensors = meter + camera if first == "shape" else camera + meter
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0"><integrator type="path"/>{sensors}</scene>')
    parsed = with_settings(parse_scene(tmp_path / "a.xml"), {"sampler": "stratified"})
    assert ["Stratified" in str(sensor.sampler()) for sensor in load_parsed(parsed).sensors()] == [True, False]


@pytest.mark.usefixtures("scalar_variant")
def test_only_a_sampler_of_the_same_plugin_keeps_its_own_parameters(tmp_path):
    own = '<sampler type="multijitter"><boolean name="jitter" value="false"/></sampler>'
    (tmp_path / "a.xml").write_text(GLASS.replace('<sampler type="independent">', own[:-10] + "<!-- -->"))
    for name, jitter in {"multijitter": False, "stratified": True}.items():
        parsed = with_settings(parse_scene(tmp_path / "a.xml"), {"sampler": name})
        text = str(load_parsed(parsed).sensors()[0].sampler())
        assert f"jitter = {int(jitter)}" in text


@pytest.mark.usefixtures("scalar_variant")
def test_a_pilot_needs_a_jit_variant(tmp_path):
    with pytest.raises(ValueError, match=r"samples cannot be rendered one by one; expected .* llvm_ad_rgb"):
        resume(Job(BALL, {"res": "8"}, settings=AUTO), tmp_path / "a.exr")
    assert not [*tmp_path.iterdir()]


# A pilot of a scene ---------------------------------------------------------------------------------------------------


def header_and_pixels(output, **options):
    header = render_to_exr(BALLS, output, defines=GLASS_ONLY, **options)
    return header, pixels(output)


def test_chosen_settings_split_at_glass_and_give_the_bits_of_the_same_settings_by_name(tmp_path, llvm_variant):
    """Only glass makes noise in this scene, and splitting has a hundredth of the variance."""
    header, chosen = header_and_pixels(tmp_path / "a.exr", spp=16, settings=AUTO)
    settings = header["mi_refract:settings"]
    assert "integrator=refract_path,split_depth=" in settings and not settings.endswith("=0")
    figures = json.loads(header["mi_refract:identity"])["pilot"]
    assert figures["costs"][settings]["value"] == 1 and figures["costs"][OWN]["value"] > 2
    header, by_name = header_and_pixels(tmp_path / "b.exr", spp=16, settings=settings)
    np.testing.assert_array_equal(by_name, chosen)
    assert header["mi_refract:settings"] == settings and "pilot" not in json.loads(header["mi_refract:identity"])
    # The finished image is refined with its own settings. A render with the scene's own settings replaces it.
    again = resume(Job(BALLS, GLASS_ONLY, settings=AUTO), tmp_path / "a.exr", Limits(spp=16))
    assert again.end() == "16 spp"  # no pilot runs, and the figures of the earlier one are not printed
    assert again.pilot_lines() == [f"the pilot of an earlier command has chosen --settings {settings}"]
    assert resume(Job(BALLS, GLASS_ONLY), tmp_path / "a.exr", Limits(spp=16)).progress.passes == 0
    # Workers receive the scene with its settings.
    assert pack(again.parsed).nodes == with_settings(parse_scene(BALLS, GLASS_ONLY), parse_settings(settings)).nodes


def test_a_checkpoint_keeps_the_chosen_settings(tmp_path, llvm_variant):
    def render_with(settings, restart=False):
        limits = Limits(spp=32, pass_spp=16)
        return resume(Job(BALLS, GLASS_ONLY, settings=settings), tmp_path / "a.exr", limits, restart=restart)

    stopped_after(render_with(AUTO), 1)
    resumed = render_with(AUTO)
    assert resumed.progress.passes == 1
    settings = resumed.progress.identity["settings"]
    assert settings != OWN and render_with(settings).progress.passes == 1
    for other in (OWN, "sampler=ldsampler"):
        with pytest.raises(CheckpointError, match=f"settings was {settings}, is {other}; pass --restart"):
            render_with(other)
    resumed.run()
    image = pixels(tmp_path / "a.exr")
    render_with(settings, restart=True).run()
    np.testing.assert_array_equal(pixels(tmp_path / "a.exr"), image)
    stopped_after(render_with(OWN, restart=True), 1)
    with pytest.raises(CheckpointError, match=f"settings was {OWN}, is auto; pass --restart"):
        render_with(AUTO)


def test_the_time_of_light_paths_excludes_compilation(tmp_path, llvm_variant, monkeypatch):
    """The second trace compiles again if Dr.Jit's cache of kernels is empty."""
    lamp = '<shape type="rectangle"><emitter type="area"/></shape>'
    (tmp_path / "a.xml").write_text(GLASS.replace('<emitter type="constant"/>', lamp))
    parsed, seconds = parse_scene(tmp_path / "a.xml"), []
    renderer = pass_renderer(load_parsed(parsed), 0)

    def trace(*arguments, **options):
        seconds.append(100 if len(seconds) < 2 else 1)
        return 2 * (np.zeros((*renderer.size[::-1], 3)),)

    monkeypatch.setattr(lamp_tracing, "lamp_image", trace)
    pixel_count = math.prod(renderer.size)
    pilot = Pilot(parsed, renderer, lambda rounded: plan_passes(pixel_count, 16, None, rounded, moments=True))
    pilot.clock = lambda: sum(seconds)
    passes = pilot.measure({"integrator": "refract_path", "caustics": "lamp"}, 0, 8)
    assert 0 < passes.seconds < 2 * 0.25 * 16 / LIGHT_PATHS


def test_the_variance_of_traced_lamps_is_that_of_the_images_of_passes(tmp_path, llvm_variant):
    lamp = '<emitter type="point"><point name="position" value="3, 1, -4"/></emitter>'
    wall = '<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/><scale value="4"/>'
    text = GLASS.replace('<emitter type="constant"/>', lamp).replace('<translate x="1" y="1.5"/>', '<translate z="3"/>')
    (tmp_path / "a.xml").write_text(text.replace('<shape type="cube"><transform name="to_world">', wall))
    parsed, settings = parse_scene(tmp_path / "a.xml"), {"integrator": "refract_path", "caustics": "lamp"}
    renderer = pass_renderer(load_parsed(parsed), 0)
    pilot = Pilot(parsed, renderer, lambda rounded: plan_passes(48, 16, None, rounded, moments=True))
    found = pilot.measure(settings, 0, 8).lamp_variance
    scene = load_parsed(with_settings(parsed, settings))
    integrator, sensor = scene.integrator(), scene.sensors()[0]
    integrator.begin_render(sensor)
    integrator.path_loop(scene, sensor.sampler())
    images = [integrator.caustic_image(scene, sensor, seed, 16, ("R", "G", "B"))[0] for seed in range(32)]
    integrator.end_render()
    # Stratified light paths have less noise than independent ones, whose variance the pilot measures.
    assert 0.5 < found / np.var(images, 0, ddof=1).mean() < 20


DARK = GLASS.replace('<emitter type="constant"/>', "")
UNMEASURABLE = {
    "no light": (DARK, "auto: the pilot sees no light; expected some"),
    "a film with a border": (
        GLASS.replace("</film>", '<boolean name="sample_border" value="true"/></film>'),
        "samples cannot be rendered one by one; expected an integrator of samples, a film without a border",
    ),
}


@pytest.mark.parametrize("scene, message", UNMEASURABLE.values(), ids=UNMEASURABLE)
def test_a_scene_that_a_pilot_cannot_measure_is_an_error(tmp_path, llvm_variant, scene, message):
    (tmp_path / "a.xml").write_text(scene)
    with pytest.raises(ValueError) as error:
        resume(Job(tmp_path / "a.xml", settings=AUTO), tmp_path / "a.exr")
    assert message in str(error.value) and "\n" not in str(error.value)
    assert [*tmp_path.iterdir()] == [tmp_path / "a.xml"]


UNSUITABLE_SAMPLERS = {
    "a sampler that is not Mitsuba's": ("fixed", "the scene's sampler is fixed; expected multijitter, .*, or settings"),
    # Its error is the same in all passes of a pixel, so they show no variance.
    "a sampler without jitter": ("multijitter", "the scene's sampler is multijitter without jitter; expected"),
}


@pytest.mark.parametrize("sampler, message", UNSUITABLE_SAMPLERS.values(), ids=UNSUITABLE_SAMPLERS)
def test_a_sampler_whose_noise_cannot_be_measured_is_an_error(tmp_path, llvm_variant, sampler, message):
    class Fixed(mi.Sampler):
        pass

    mi.register_sampler("fixed", Fixed)
    jitter = '<boolean name="jitter" value="false"/>' if sampler == "multijitter" else ""
    text = GLASS.replace('sampler type="independent">', f'sampler type="{sampler}">{jitter}')
    (tmp_path / "a.xml").write_text(text)
    job = Job(tmp_path / "a.xml", allow_plugins=["fixed"], settings=AUTO)
    with pytest.raises(ValueError, match=message):
        resume(job, tmp_path / "a.exr", Limits(spp=4, pass_spp=4))


def test_the_time_limit_of_a_render_includes_its_pilot(tmp_path, llvm_variant, monkeypatch):
    """Each reading of the clock moves it by a second, and the pilot exceeds the limit: one pass is rendered."""
    clock = itertools.count()
    monkeypatch.setattr(time, "monotonic", lambda: float(next(clock)))

    def slow_choice(pilot):
        for _ in range(60):
            time.monotonic()
        return Choice({}, {"seconds": 60.0, "of": OWN, "costs": {}})

    monkeypatch.setattr(long_render, "choose", slow_choice)
    render = resume(Job(BALL, {"res": "8"}, settings=AUTO), tmp_path / "a.exr", Limits(seconds=60, pass_spp=1))
    render.run()
    assert render.progress.passes == 1 and render.ended_by == "--time 60 s"


def test_samplers_that_do_not_support_the_samples_of_a_pass_are_no_candidates(tmp_path, llvm_variant):
    """Of those that Mitsuba has, only the scene's own, `independent`, has passes of 5 samples."""
    (tmp_path / "a.xml").write_text(GLASS)
    render = resume(Job(tmp_path / "a.xml", settings=AUTO), tmp_path / "a.exr", Limits(spp=10, pass_spp=5))
    assert not any("sampler" in name for name in render.progress.identity["pilot"]["costs"])


@pytest.mark.parametrize("integrator", ["depth", "refract_path"])
def test_a_scene_keeps_an_integrator_other_than_path(tmp_path, llvm_variant, integrator):
    """Also the one without noise."""
    flag = '<boolean name="deterministic" value="true"/>' * (integrator == "refract_path")
    own = f'<integrator type="{integrator}">{flag}</integrator>'
    mirror = '</transform><bsdf type="conductor"/></shape>'
    scene = re.sub("<integrator.*/integrator>", own, GLASS).replace("</transform></shape>", mirror)
    (tmp_path / "a.xml").write_text(scene)
    render = resume(Job(tmp_path / "a.xml", settings=AUTO), tmp_path / "a.exr", Limits(spp=4))
    costs = render.progress.identity["pilot"]["costs"]
    assert [*costs] == [OWN, "sampler=multijitter"]
