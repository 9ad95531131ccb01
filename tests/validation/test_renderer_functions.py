"""Functions of refraction of other systems: what they do with vectors of other lengths, and where they cannot run."""

import dataclasses
import sys

import numpy as np
import pytest

from mi_refract.accuracy import backward_error
from mi_refract.ray_sets.files import parse_answers
from mi_refract.ray_sets.renderer_file import RaysCommand
from validation.suite import per_ray
from validation.suite.renderers import SYSTEMS, environments
from validation.suite.renderers.system import CRITICAL, SCRIPTS, Npm, Pip, System

COUNT = 60
CALLS = {
    f"{name} {call.precision}": (system, call)
    for name, system in SYSTEMS.items()
    for call in system.calls
    if call.lengths
}
HEADER = "id,ax,ay,az,nx,ny,nz,n_from,n_to"


@pytest.fixture(scope="module")
def vectors():
    """(a, n, n_from, n_to), of unit length: into a denser and a thinner medium, half of these totally reflected."""
    rng = np.random.default_rng(7)
    a, n = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, COUNT, 3)))
    n = np.where((a * n).sum(1, keepdims=True) > 0, -n, n)
    n_from = np.where(np.arange(COUNT) % 2, 1.5, 1.0)
    return a, n, n_from, 2.5 - n_from


def textbook(a, n, k):
    """k a − (k c + √(1 − k²(1 − c²))) n of vectors of any length; NaN where the radicand is negative."""
    k, c = k[:, None], (a * n).sum(1, keepdims=True)
    radicand = 1 - k * k * (1 - c * c)
    return k * a - (k * c + np.sqrt(np.where(radicand < 0, np.nan, radicand))) * n


def scaled(v):
    return v / np.linalg.norm(v, axis=1, keepdims=True)


USED = "takes vectors of any length as they are"
SCALED = "scales the ray to unit length"
BY_SPEED = "takes the index that a ray leaves from its speed 1/n, not from the medium"
# What a system does, by what is said of it, of the ray a, the normal n and the two indices.
MEANINGS = {
    USED: lambda a, n, n_from, n_to: textbook(a, n, n_from / n_to),
    SCALED: lambda a, n, n_from, n_to: textbook(scaled(a), n, n_from / n_to),
    BY_SPEED: lambda a, n, n_from, n_to: textbook(scaled(a), n, n_from / np.linalg.norm(a, axis=1) / n_to),
}


def as_rows(a, n, n_from, n_to):
    return "\n".join(
        [HEADER, *(",".join(map(repr, (i, *row))) for i, row in enumerate(np.c_[a, n, n_from, n_to].tolist()))]
    )


def means(system, call, vectors):
    """The meanings that agree with every answer to rays twice as long, and to normals where these count."""
    a, n, n_from, n_to = vectors
    found = set(MEANINGS)
    for a_by, n_by in ((1, 1), (2, 1), (1, 2) if call.lengths == USED else (0.5, 1)):
        given = a_by * a, n_by * n, n_from, n_to
        b = parse_answers(environments.ask(system, call.command, as_rows(*given)), call.title).b
        for name in sorted(found):
            expected = MEANINGS[name](*given)
            through = np.isfinite(expected[:, 0])
            if a_by == n_by == 1:
                assert 0 < through.sum() < COUNT, "some are totally reflected, not all"
            if not np.allclose(b[through], expected[through], atol=1e-4 if call.precision == "f32" else 1e-12):
                found.discard(name)
    return found


@pytest.mark.parametrize("name", CALLS)
def test_vectors_of_other_lengths_are_treated_as_the_table_says(name, vectors):
    system, call = CALLS[name]
    if reason := environments.absent(system):
        pytest.skip(reason)
    try:
        assert means(system, call, vectors) == {call.lengths}
    except environments.Unable as reason_here:
        pytest.skip(f"cannot run here: {reason_here}")


def test_every_treatment_of_lengths_has_a_meaning_and_is_said():
    assert {call.lengths for _, call in CALLS.values()} == set(MEANINGS)
    rays = per_ray.given("f64")
    for lengths in ("", *MEANINGS):
        call = RaysCommand("a", "f64", (), "zero", lengths=lengths, remark="known")
        answers = parse_answers("\n".join(["id,bx,by,bz", *(f"{i},0,0,0" for i in rays.ids.tolist())]), "a")
        reason = per_ray.rows(call, rays, answers)[0].reason
        assert "known" in reason and lengths in reason and "; ;" not in reason


def test_raysect_s_reciprocals_of_lengths_count_near_the_critical_angle():
    """Without them the formula leaves 1.5 u on these rays; with them 4.26 u, as raysect does."""
    rays = per_ray.given("f64")
    rays = rays.rays[rays.regime == CRITICAL]

    def worst(a, n):
        b = textbook(a, n, rays.k)
        return backward_error.of_directions(b[np.isfinite(b[:, 0])], rays[np.isfinite(b[:, 0])]).max() / 2**-53

    assert worst(rays.a, rays.n) < 2
    assert 4 < worst(*(v * (1 / np.sqrt((v * v).sum(1, keepdims=True))) for v in (rays.a, rays.n))) < 5


def test_prysm_takes_a_normal_on_the_far_side_only():
    if reason := environments.absent(SYSTEMS["prysm"]):
        pytest.skip(reason)
    asked = (
        "import numpy as np; from prysm.experimental.raytracing.spencer_and_murty import refract; "
        "[print(*refract(1, 1.5, np.array([[0.6, 0, 0.8]]), np.array([[0, 0, z]]))[0].tolist()) for z in (1.0, -1.0)]"
    )
    far, near = environments.run([environments.python(SYSTEMS["prysm"]), "-c", asked]).splitlines()
    np.testing.assert_allclose(np.array(far.split(), float), [0.4, 0, np.sqrt(1 - 0.4**2)], atol=1e-15)
    np.testing.assert_allclose(np.array(near.split(), float), [0.4, 0, -np.sqrt(1 - 0.4**2)], atol=1e-15)


def test_frames_are_rotations_onto_the_normal(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import table

    axes = np.vstack([np.eye(3), -np.eye(3)])
    n = np.vstack([scaled(np.random.default_rng(3).normal(size=(1000, 3))), axes, scaled(axes - 1e-9)])
    frames = table.frames(n)
    np.testing.assert_array_equal(frames[:, :, 2], n)
    np.testing.assert_allclose(np.swapaxes(frames, 1, 2) @ frames, np.broadcast_to(np.eye(3), frames.shape), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(frames), 1, atol=1e-15)


def test_things_apart_are_in_no_row(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import table

    places = table.apart(range(200))
    assert all(len(np.unique(places[:, axis])) == len(places) for axis in range(3))
    gaps = np.linalg.norm(places[:, None] - places, axis=2)[~np.eye(len(places), dtype=bool)]
    assert gaps.min() > 0.5 - 1e-9


# Where they cannot run -------------------------------------------------------------------------------------------


def test_a_script_for_node_is_told_its_folder_and_cannot_run_without_node(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    system = System("thing", "Thing", "none", Npm(("a@1",)), 0)
    monkeypatch.setattr("shutil.which", lambda program: f"/bin/{program}")
    asked = []
    monkeypatch.setattr(environments, "run", lambda *words, **named: asked.append(words))
    command = ("node", "thing.mjs", "{environment}")
    environments.ask(system, command, "rays")
    assert asked[0][:2] == (["node", "thing.mjs", str(environments.folder(system))], "rays")
    monkeypatch.setattr("shutil.which", lambda program: None)
    with pytest.raises(environments.Unable, match="no node in PATH"):
        environments.ask(system, command, "rays")


@pytest.mark.parametrize(
    ("name", "hidden", "said"),
    [
        ("wgsl", {"VK_DRIVER_FILES": "/nowhere", "VK_ICD_FILENAMES": "/nowhere"}, "mesa-vulkan-drivers libvulkan1"),
        ("glsl", {"__EGL_VENDOR_LIBRARY_DIRS": "/nowhere"}, "libegl1 libgl1-mesa-dri"),
        ("materialx", {"__EGL_VENDOR_LIBRARY_DIRS": "/nowhere"}, "libegl1 libgl1-mesa-dri"),
        ("slang", {"PATH": "/nowhere"}, "Debian: g++"),
        ("thi_ng", {"PATH": "/nowhere"}, "no node in PATH"),
    ],
)
def test_without_its_driver_or_compiler_a_system_is_not_run_and_says_what_is_missing(name, hidden, said, monkeypatch):
    system = dataclasses.replace(SYSTEMS[name], small=True)
    if reason := environments.absent(system):
        pytest.skip(reason)
    for variable, value in hidden.items():
        monkeypatch.setenv(variable, value)
    for call in system.calls:
        (row,) = per_ray.call_rows(system, call, None)
        assert row.verdict == "not run" and row.reason.startswith("cannot run here: ") and said in row.reason


# Built from source -----------------------------------------------------------------------------------------------


def test_a_package_without_a_wheel_is_built_by_locked_tools_after_them(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(environments, "LOCKS", tmp_path)
    for name in ("thing.txt", "thing.source.txt"):
        (tmp_path / name).write_text(name)
    done = []
    monkeypatch.setattr(environments, "_do", lambda system, given: done.append(given))
    system = System("thing", "Thing", "none", Pip(("a==1", "setuptools"), built="a"), 0)
    environments.install(system)
    _, wheels, source = done
    assert {"--require-hashes", "--only-binary", "--no-deps"} < {*wheels} and wheels[-1].endswith("thing.txt")
    assert {"--require-hashes", "--no-build-isolation", "--no-binary", "--no-deps"} < {*source}
    assert source[-1] == str(environments.locked_source(system)) and sys.executable == source[0]
    assert not environments.absent(system)
    (tmp_path / "thing.source.txt").write_text("another source")
    assert environments.absent(system)
