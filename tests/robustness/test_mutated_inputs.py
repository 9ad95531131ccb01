"""Mutated inputs: every parser answers garbage with an error in one line, or with the right content.

`pytest tests/robustness --hypothesis-profile=long` tries a thousand inputs of each parser, anew each time. The input
that hangs or ends the process is the file `mutated.*` in the folder of the test.
"""

from __future__ import annotations

import contextlib
import dataclasses
import faulthandler
import io
import json
import math
import os
import re
import resource
import shutil
import sys
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.variants import switch

from mi_refract import oracle
from mi_refract.image_diff import folders, settings_file
from mi_refract.image_diff.results import Status
from mi_refract.io import exit_code, image_file
from mi_refract.planar import scene_file
from mi_refract.plugins import scene_parser
from mi_refract.ray_sets import check_answers, files, ray_set, renderer_file
from mi_refract.rendering import scene_files
from mi_refract.report import run_report
from mi_refract.report.row import Row
from mi_refract.scene_export import from_mitsuba, write_files

SCENES = Path(__file__).parents[2] / "scenes"
LONGEST, HANG = 10.0, 60.0  # CPU seconds of one input; seconds after which the process ends
ADDRESSES = 12 << 30  # bytes of address space beyond what is used: a reader may ask for the most it accepts
MEMORY = 2 << 30  # bytes that a scene may take: the largest film is accepted
HEADER = 700  # bytes of an EXR file in front of its pixels
FAR = 1e-3  # radians: no bound of a generic ray in float32 excuses as much
PIXELS = 64  # of a film that is rendered

# Mutations ------------------------------------------------------------------------------------------------------------

INTEGERS = (0, 1, 2, 127, 128, 255, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
WORDS = [*(value.to_bytes(size, "little") for size in (2, 4, 8) for value in INTEGERS if value < 256**size)]
DEEP = [b"[" * 5000, b"{" * 3000, b'{"a":' * 2000, b"9" * 400, b"1" * 5000]
WORDS += [*DEEP, b"\xff\xfe", b"\r", b"\n"]
WORDS += b"""\xed\xb2\x80 nan inf -inf NaN(ind) nan( 1e999 -0 0 1e-320 18446744073709551616 -1 0x1p-1074 true null [] {}
"" [[]] 1_000 \x00 \xe2\x80\xae \x1b[31m ##[error] ::error:: [/red] # , " ' = ../../x 2147483648 4294967295""".split()
XML_WORDS = [b"", b"$" * 3000, b"x" * 5000, b"1, nan, 0"]
XML_WORDS += b"""&amp; &#0; $ $res 1000000 1e30 nan inf -1 0 2147483647 4294967295 bk7 ../x /dev/zero mutated.xml
plugins""".split()
ELEMENTS = (
    b'<bsdf type="twosided">%s</bsdf>', b'<shape type="instance">%s</shape>', b"<a>%s</a>", b"<!-- %s -->",
    b"<![CDATA[%s", b'<include filename="mutated.xml"/>%s', b'<default name="res" value="99999"/>%s',
    b'<path value="meshes"/>%s', b'<ref id="glass"/>%s', b'<bsdf type="mask" id="glass"><ref id="glass"/></bsdf>%s',
    b"<!DOCTYPE a>%s",
)  # fmt: skip
TOKEN = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?|[A-Za-z_][\w.]*|\"[^\"\n]*\"|^.*\n", re.MULTILINE)
VALUE = re.compile(rb"(?<=[=:] )[^\n,]+|(?<=,)[^\n,]+")
ATTRIBUTE, ELEMENT = re.compile(rb'(?<==")[^"]*(?=")'), re.compile(rb"<(?=[a-z])")


@st.composite
def mutated(draw, good, head=None, tokens=TOKEN, words=WORDS):
    """One of `good` with one to four pieces replaced: of the first `head` bytes, three times out of four."""
    data = draw(st.sampled_from(good))
    for _ in range(draw(st.integers(1, 4))):
        near = min(len(data), head if head and draw(st.integers(0, 3)) else len(data))
        start = draw(st.integers(0, near))
        spans = [found.span() for found in tokens.finditer(data, 0, near)] or [(start, start)]
        some = st.integers(0, 12) | st.just(near)
        start, stop = draw(st.sampled_from(spans)) if draw(st.booleans()) else (start, start + draw(some))
        copied = slice(*draw(st.sampled_from(spans)))
        times = draw(st.sampled_from([1, 2, 50]))
        new = draw(st.sampled_from(words) | st.binary(max_size=8) | st.just(b"") | st.just(data[copied] * times))
        data = data[:start] + new + data[stop:]
    return data


@st.composite
def deep(draw, good):
    """A value is brackets without end, or digits."""
    data = draw(st.sampled_from(good))
    start, stop = draw(st.sampled_from([found.span() for found in VALUE.finditer(data)] or [(0, len(data))]))
    return data[:start] + draw(st.sampled_from(DEEP)) + data[stop:]


@st.composite
def mutated_xml(draw, good):
    """Most of it is still XML: values of attributes are replaced, elements inserted."""
    data = draw(st.sampled_from(good))
    for _ in range(draw(st.integers(1, 4))):
        if draw(st.integers(0, 4)):
            start, stop = draw(st.sampled_from([found.span() for found in ATTRIBUTE.finditer(data)] or [(0, 0)]))
            data = data[:start] + draw(st.sampled_from(XML_WORDS)) + data[stop:]
        else:
            begin, end = draw(st.sampled_from(ELEMENTS)).split(b"%s")
            at = draw(st.sampled_from([0, *(found.start() for found in ELEMENT.finditer(data))]))
            count = draw(st.sampled_from([1, 2, 40, 20_000]))
            data = data[:at] + begin * count + end * count + data[at:]
    return data


@st.composite
def mutated_member(draw, good):
    """Of a zip archive, whose checksums are right."""
    with zipfile.ZipFile(io.BytesIO(good)) as old:
        members = {name: old.read(name) for name in old.namelist()}
    chosen = draw(st.sampled_from(sorted(members)))
    members[chosen] = draw(mutated([members[chosen]], head=128))
    with zipfile.ZipFile(buffer := io.BytesIO(), "w") as new:
        for name, content in members.items():
            new.writestr(name, content)
    return buffer.getvalue()


# Parsers --------------------------------------------------------------------------------------------------------------


@dataclass
class Parser:
    """Good inputs, and `read`: of a bad one it raises one line, or returns what is wrong with accepting it, or ""."""

    suffix: str
    good: list[bytes]
    read: Callable[[Path], str | None]
    head: int | None = None

    @property
    def inputs(self):
        plain = mutated(self.good, self.head)
        if self.suffix == ".xml":
            return st.one_of(plain, mutated_xml(self.good), mutated_xml(self.good))
        if self.suffix == ".npz":
            return plain | mutated_member(*self.good)
        return plain if self.head else plain | deep(self.good)


SETTINGS = b"""[[image]]
name = "glass/caustic*.exr"
method = "tolerance"
fail = 0.02
reason = "single-precision caustic: last bits differ"

[[image]]
name = "noise.exr"
method = "welch"
family_error = 0.01
allow_nonfinite = true
reason = "an estimate"
"""
RENDERER = b"""title = "T"
[[rays]]
title = "r"
precision = "f32"
command = ["./r"]
gives_up = 1e-6
recorded = { random = 1e-6, near-critical = [1e-4, 2e-4] }
"""
MESH = """<scene version="3.0.0">
<integrator type="path"><integer name="max_depth" value="8"/></integrator>
<sensor type="perspective"><film type="hdrfilm">
<integer name="width" value="4"/><integer name="height" value="4"/></film></sensor>
<shape type="ply"><boolean name="face_normals" value="true"/>
<string name="filename" value="mutated.ply"/><bsdf type="dielectric"/></shape></scene>"""
SMALL = {"res": "4", "bsdf": "dielectric", "max_depth": "8"}
TARGETS = [name for name in write_files.TARGETS if name != "povray"]  # which has glass and lights only


def of_files(folder: Path) -> dict[str, Parser]:
    rays = ray_set.make(("generic",), 6)
    for name in ("rays.csv", "rays.npz", "rays.exr"):
        files.write(folder / name, rays)
    a, n, k = rays.rays.a, rays.rays.n, rays.rays.k
    b = oracle.refract(a, n, k, fresnel=False, progress=False).direction.astype(np.float32).astype(np.float64)
    header = [f"# {key}: {json.dumps(value)}" for key, value in rays.header.items()]
    table = [f"{i},{x!r},{y!r},{z!r}" for i, (x, y, z) in zip(rays.ids.tolist(), b.tolist(), strict=True)]
    (folder / "answers.csv").write_text("\n".join([*header, "id,bx,by,bz", *table, ""]))
    np.savez(folder / "answers.npz", id=rays.ids, b=b)
    image = folder / "image.exr"
    image_file.write_exr(image, np.linspace(0.1, 1, 12 * 8 * 3).reshape(8, 12, 3), metadata={"mi_refract:spp": 16})
    row = Row("directions", "promoted", "generic", "scalar", {"worst": 0.5}, budgets={"worst": 1.0}, replay={"seed": 1})
    run_report.write_json(folder / "rows.json", [row], {"title": "x"})
    reference, renderer = image_file.read(image), folder / "renderer"
    renderer.mkdir()

    def same_rays(path):
        found = files.read(path)
        same = found.header == rays.header and np.array_equal(found.numbers, rays.numbers)
        return None if same else "other rays than those that were exported"

    def answers(path):
        """Those that `rays check` calls right."""
        found = files.read_answers(path)
        if check_answers.check(rays, found).exit_code:
            return None
        if sorted(found.ids.tolist()) != rays.ids.tolist():
            return "exit code 0 for other ids"
        away = np.linalg.norm(found.b[np.argsort(found.ids)] - b, axis=1)
        return None if (away < FAR).all() else f"exit code 0 for a direction that is {away.max():g} away"

    def equal(path):
        (result,) = folders.diff(image, path).results
        if result.error:
            raise ValueError(result.error)
        if result.status is not Status.EQUAL:
            return None
        pixels = image_file.read(path).pixels
        return None if np.allclose(pixels, reference.pixels, rtol=0.05, atol=0.05) else "equal to other pixels"

    def read_renderer(path):
        shutil.copy(path, renderer / renderer_file.NAME)
        renderer_file.load(renderer)

    def known(load):
        return lambda path: load(path) and None

    def of(name):
        return [(folder / name).read_bytes()]

    planar = [(SCENES / "planar" / f"{name}.toml").read_bytes() for name in ("lens", "nested", "prism", "doublet")]
    return {
        "planar scene, TOML": Parser(".toml", planar, known(scene_file.load)),
        "diff settings, TOML": Parser(".toml", [SETTINGS], known(settings_file.load)),
        "renderer, TOML": Parser(".toml", [RENDERER], read_renderer),
        "rows, JSON": Parser(".json", of("rows.json"), known(run_report.read_json)),
        "rays, CSV": Parser(".csv", of("rays.csv"), same_rays),
        "rays, NPZ": Parser(".npz", of("rays.npz"), same_rays),
        "rays, EXR": Parser(".exr", of("rays.exr"), same_rays, HEADER),
        "answers, CSV": Parser(".csv", of("answers.csv"), answers),
        "answers, NPZ": Parser(".npz", of("answers.npz"), answers),
        "image, EXR": Parser(".exr", of("image.exr"), equal, HEADER),
    }


def of_scenes(folder: Path) -> dict[str, Parser]:
    """Scenes and their meshes, read as `render` and `scene export` read them, up to the first sample.

    Beside them there is a false plugin for every word of the good ones; Mitsuba says so where it opens one.
    """
    shutil.copytree(SCENES / "meshes", folder / "meshes")
    shutil.copy(SCENES / "lamps.exr", folder)
    (folder / "mesh.xml").write_text(MESH)
    (folder / "sky.xml").write_text((SCENES / "balls.xml").read_text().replace("lamps.exr", "mutated.exr"))
    names = ("balls", "furnace", "nested", "prism", "slab", "sphere")
    scenes = [(SCENES / f"{name}.xml").read_bytes() for name in names]
    (folder / "plugins").mkdir()
    words = {word for scene in scenes for word in re.findall(r"[A-Za-z_][\w-]*", scene.decode())}
    for name in words | scene_parser.known_plugins():
        (folder / "plugins" / f"{name}.so").write_text("native code")

    def by_turns(path):
        """Every other scene as it is, whose film is made; the others small, and so they are rendered."""
        return rendered(path, SMALL if path.stat().st_size % 2 else {})

    mesh, sky = [(SCENES / "meshes" / "prism.ply").read_bytes()], [(SCENES / "lamps.exr").read_bytes()]
    return {
        "scene, XML": Parser(".xml", scenes, bounded(by_turns)),
        "scene to export, XML": Parser(".xml", scenes, bounded(exported)),
        "sky, EXR": Parser(".exr", sky, bounded(lambda path: rendered(folder / "sky.xml", SMALL)), HEADER),
        "mesh, PLY": Parser(".ply", mesh, bounded(lambda path: rendered(folder / "mesh.xml", {}))),
    }


def peak():
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def bounded(read):
    """`read`, which must neither open the false plugins nor take more than MEMORY."""

    def call(path):
        before = peak()
        try:
            wrong = read(path)
        except ValueError as error:
            if "Error while loading plugin" in str(error):
                return f"a plugin of the scene's own was opened: {error}"
            if peak() - before <= MEMORY:
                raise
            wrong = None
        return wrong or (f"took {peak() - before} bytes of memory" if peak() - before > MEMORY else None)

    return call


def rendered(path, defines):
    import mitsuba as mi

    scene = scene_files.load_scene(path, defines)
    meshes = (shape for shape in scene.shapes() if shape.is_mesh())
    if any(np.max(np.array(mesh.faces_buffer()), initial=0) >= mesh.vertex_count() for mesh in meshes):
        return "a face without its vertices"
    film = scene.sensors()[0].film()
    if math.prod(film.crop_size()) <= PIXELS:
        mi.render(scene, spp=1)
    else:
        film.prepare([])
    return None


def exported(path):
    """The scene is written for one of the targets, by turns."""
    plain = from_mitsuba.load(path, level=1)
    write_files.TARGETS[TARGETS[path.stat().st_size % len(TARGETS)]](plain)
    parts = [*dataclasses.astuple(plain.camera), *(x for m in plain.materials for x in dataclasses.astuple(m))]
    return None if np.isfinite(np.hstack(parts)).all() else "a number that is not finite"


# Tests ----------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("inputs")


@pytest.fixture(scope="module")
def parsers(folder):
    switch("scalar_rgb")
    return of_files(folder) | of_scenes(folder)


@contextlib.contextmanager
def limited():
    """No endless input, and no more than ADDRESSES."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + ADDRESSES, before[1]))
    faulthandler.dump_traceback_later(HANG, exit=True, file=sys.__stderr__)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        resource.setrlimit(resource.RLIMIT_AS, before)


def outcome(read, path) -> str:
    """Of an input: read or refused; an AssertionError for a finding."""
    began = time.process_time()
    try:
        with limited():
            wrong, found = read(path), "read"
    except Exception as error:
        wrong, found = None, "refused"
        assert not exit_code.describe(error).startswith("internal error"), exit_code.describe(error)
        assert not isinstance(error, ValueError) or "\n" not in str(error), f"several lines: {error}"
    assert not wrong, wrong
    assert time.process_time() - began < LONGEST
    return found


KINDS = (
    *(f"{name}, TOML" for name in ("planar scene", "diff settings", "renderer")), "rows, JSON",
    *(f"rays, {kind}" for kind in ("CSV", "NPZ", "EXR")), "answers, CSV", "answers, NPZ", "image, EXR",
    "scene, XML", "scene to export, XML", "sky, EXR", "mesh, PLY",
)  # fmt: skip


@pytest.mark.usefixtures("scalar_variant")
@pytest.mark.parametrize("name", KINDS)
def test_garbage_is_answered_in_one_line(name, parsers, folder):
    parser, outcomes = parsers[name], Counter()
    path = folder / f"mutated{parser.suffix}"
    for content in parser.good:
        path.write_bytes(content)
        assert outcome(parser.read, path) == "read"

    @given(parser.inputs)
    def read(content):
        path.write_bytes(content)
        outcomes[outcome(parser.read, path)] += 1

    read()
    assert outcomes["refused"] > 0


# What lets it through: what of `scene_parser` is replaced, and what is found then.
LET_THROUGH = {
    "plugin": ("scene, XML", b"</scene>", b'<bsdf type="checkerboard"><bsdf type="near_clip"/></bsdf></scene>',
               "check_plugins", "a plugin of the scene's own was opened"),
    "vertex": ("mesh, PLY", b"3 0 3 4", b"3 0 3 6", "check_faces", "a face without its vertices"),
}  # fmt: skip


@pytest.mark.usefixtures("scalar_variant")
@pytest.mark.parametrize("case", LET_THROUGH)
def test_what_a_scene_must_not_do_is_refused_and_would_be_found(case, parsers, folder, monkeypatch):
    name, old, new, check, message = LET_THROUGH[case]
    parser = parsers[name]
    path = folder / f"mutated{parser.suffix}"
    assert parser.good[-1].count(old) == 1
    path.write_bytes(parser.good[-1].replace(old, new))
    assert outcome(parser.read, path) == "refused"
    monkeypatch.setattr(scene_parser, check, lambda *arguments: None)
    with pytest.raises(AssertionError, match=message):
        outcome(parser.read, path)


def raises(error):
    raise error


@pytest.mark.parametrize(
    "read, found",
    [
        (lambda path: raises(KeyError("x")), "internal error: KeyError"),
        (lambda path: "garbage", "garbage"),
        (lambda path: raises(ValueError("a\nb")), "several lines"),
        (lambda path: raises(ValueError("a: b")), None),
        (lambda path: raises(MemoryError()), None),
        (lambda path: bytearray(2 * ADDRESSES) and "accepted", None),
    ],
)
def test_what_counts_as_a_finding(read, found, tmp_path):
    with pytest.raises(AssertionError, match=found) if found else contextlib.nullcontext():
        assert outcome(read, tmp_path) == "refused"


@pytest.mark.parametrize("answer", [lambda: None, lambda: raises(ValueError("a: b"))])
def test_a_scene_that_takes_memory_is_a_finding(answer, tmp_path, monkeypatch):
    peaks = iter([5, 5 + MEMORY + 1, 5 + MEMORY + 1, 5 + MEMORY + 1])
    monkeypatch.setitem(globals(), "peak", lambda: next(peaks))
    assert bounded(lambda path: answer())(tmp_path).startswith("took 2147483649 bytes")
