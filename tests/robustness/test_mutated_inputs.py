"""Mutated inputs: every parser either refuses garbage with an error of one line, or reads the right content.

`pytest tests/robustness --hypothesis-profile=long` tries a thousand inputs per parser, others in each run. An input
that hangs or kills the process remains as the file `mutated.*` in the folder of the test.
"""

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
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.variants import switch

from mi_refract import SCENES, oracle
from mi_refract.image_diff import folders, settings
from mi_refract.image_diff.results import Status
from mi_refract.io import errors, image_file
from mi_refract.numerics import mitsuba_mesh
from mi_refract.planar import scene_file
from mi_refract.plugins import scene_parser
from mi_refract.ray_sets import check_answers, files, ray_set, renderer_file
from mi_refract.rendering import scene_files
from mi_refract.scene_export import from_mitsuba, targets

LONGEST, HANG = 10.0, 60.0  # limit for one input in CPU seconds; seconds after which the process is ended
ADDRESSES = 12 << 30  # additional address space in bytes: a reader may allocate the largest size that it accepts
MEMORY = 2 << 30  # additional memory for one input in bytes: the largest film is accepted
HEADER = 700  # size of an EXR file's header in bytes
FAR = 1e-3  # radians: larger than the error bound of every generic ray in float32
PIXELS = 64  # films of up to this many pixels are rendered

# Mutations -----------------------------------------------------------------------------------------------------------

INTEGERS = (0, 1, 2, 127, 128, 255, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
WORDS = [value.to_bytes(size, "little") for size in (2, 4, 8) for value in INTEGERS if value < 256**size]
WORDS += [b"[" * 5000, b"{" * 3000, b'{"a":' * 2000, b"9" * 400, b"\xff\xfe", b"\r", b"\n", b"# ", b"\xed\xb2\x80"]
WORDS += b"""nan inf -inf NaN(ind) nan( 1e999 -0 0 1e-320 18446744073709551616 -1 0x1p-1074 true null [] {} ""
[[]] 1_000 \x00 \xe2\x80\xae \x1b[31m ##[error] ::error:: [/red] , " ' = ../../x 2147483648 4294967295""".split()
XML_WORDS = [b"", b"$" * 3000, b"x" * 5000, b"1, nan, 0"]
XML_WORDS += b"""&amp; &#0; $ $res 1000000 1e30 nan inf -1 0 2147483647 4294967295 bk7 ../x mutated.xml
plugins""".split()
ELEMENTS = [
    b'<bsdf type="twosided">|</bsdf>', b'<shape type="instance">|</shape>', b"<a>|</a>", b"<!-- | -->", b"<![CDATA[|",
    b'<default name="res" value="99999"/>|', b'<path value="meshes"/>|',
    b'<ref id="glass"/>|', b'<bsdf type="mask" id="glass"><ref id="glass"/></bsdf>|', b"<!DOCTYPE a>|",
]  # fmt: skip
ELEMENTS = [part[0] * n + part[1] * n for part in (x.split(b"|") for x in ELEMENTS) for n in (1, 2, 40)]
ELEMENTS.append(b'<include filename="mutated.xml"/>')
TOKEN = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?|[A-Za-z_][\w.]*|\"[^\"\n]*\"|^.*\n", re.MULTILINE)
XML_TOKEN = re.compile(rb'(?<==")[^"]*(?=")|(?=<[a-z])')  # values of attributes, and places in front of an element


@st.composite
def mutated(draw, good, head=None, tokens=TOKEN, words=WORDS):
    """Return one of `good` with one to four pieces replaced, three of four times within the first `head` bytes."""
    data = draw(st.sampled_from(good))
    for _ in range(draw(st.integers(1, 4))):
        end = min(len(data), head if head and draw(st.integers(0, 3)) else len(data))
        start = draw(st.integers(0, end))
        spans = [match.span() for match in tokens.finditer(data, 0, end)] or [(start, start)]
        if draw(st.booleans()):
            start, stop = draw(st.sampled_from(spans))
        else:
            stop = start + draw(st.integers(0, 12) | st.just(end))
        token = data[slice(*draw(st.sampled_from(spans)))]
        copies = st.sampled_from([b"", token, token * 50])
        piece = draw(st.sampled_from(words) | st.binary(max_size=8) | copies)
        data = data[:start] + piece + data[stop:]
    return data


@st.composite
def mutated_member(draw, good):
    """Return a zip archive with one mutated member and right checksums."""
    with zipfile.ZipFile(io.BytesIO(good)) as old:
        members = {name: old.read(name) for name in old.namelist()}
    mutated_name = draw(st.sampled_from(sorted(members)))
    members[mutated_name] = draw(mutated([members[mutated_name]], head=128))
    with zipfile.ZipFile(buffer := io.BytesIO(), "w") as new:
        for member, content in members.items():
            new.writestr(member, content)
    return buffer.getvalue()


def inputs(suffix, good):
    """Return a strategy for mutations of the good contents of files with this suffix."""
    plain = mutated(good, HEADER if suffix == ".exr" else None)
    if suffix == ".xml":  # most of these are still XML
        return plain | mutated(good, tokens=XML_TOKEN, words=XML_WORDS + ELEMENTS)
    return plain | mutated_member(good[0]) if suffix == ".npz" else plain


# Parsers: suffix, good contents, and a function that raises an error, or returns why accepting the file was wrong

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


def file_parsers(folder):
    """Return the parsers of files other than scenes."""
    rays = ray_set.make(("generic",), 6)
    for name in ("rays.csv", "rays.npz"):
        files.write(folder / name, rays)
    a, n, k = rays.rays.a, rays.rays.n, rays.rays.k
    b = oracle.refract(a, n, k, fresnel=False, progress=False).direction.astype(np.float32).astype(np.float64)
    header = [f"# {key}: {json.dumps(value)}" for key, value in rays.header.items()]
    table = [f"{i},{x!r},{y!r},{z!r}" for i, (x, y, z) in zip(rays.ids.tolist(), b.tolist(), strict=True)]
    (folder / "answers.csv").write_text("\n".join([*header, "id,bx,by,bz", *table, ""]))
    np.savez(folder / "answers.npz", id=rays.ids, b=b)
    image = folder / "image.exr"
    image_file.write_exr(image, np.linspace(0.1, 1, 12 * 8 * 3).reshape(8, 12, 3), metadata={"mi_refract:spp": 16})
    reference = image_file.read(image)
    (folder / "renderer").mkdir()

    def same_rays(path):
        read = files.read(path)
        same = read.header == rays.header and np.array_equal(read.numbers, rays.numbers)
        return None if same else "other rays than those that were exported"

    def answers(path):
        """Read answers; return an error if `rays check` accepts wrong ones."""
        read = files.read_answers(path)
        if check_answers.check(rays, read).exit_code:
            return None
        if sorted(read.ids.tolist()) != rays.ids.tolist():
            return "exit code 0 for other ids"
        error = np.linalg.norm(read.b[np.argsort(read.ids)] - b, axis=1)
        return None if (error < FAR).all() else f"exit code 0 for a direction with an error of {error.max():g}"

    def equal(path):
        (result,) = folders.diff(image, path).results
        if result.error:
            raise ValueError(result.error)
        close = np.allclose(image_file.read(path).pixels, reference.pixels, rtol=0.05, atol=0.05)
        return "equal to other pixels" if result.status is Status.EQUAL and not close else None

    def renderer(path):
        shutil.copy(path, folder / "renderer" / renderer_file.NAME)
        renderer_file.load(folder / "renderer")

    def contents(name):
        return [(folder / name).read_bytes()]

    planar = [(SCENES / "planar" / f"{name}.toml").read_bytes() for name in ("lens", "nested", "prism", "doublet")]
    return {
        "planar scene, TOML": (".toml", planar, lambda path: scene_file.load(path) and None),
        "diff settings, TOML": (".toml", [SETTINGS], lambda path: settings.load(path) and None),
        "renderer, TOML": (".toml", [RENDERER], renderer),
        "rays, CSV": (".csv", contents("rays.csv"), same_rays),
        "rays, NPZ": (".npz", contents("rays.npz"), same_rays),
        "answers, CSV": (".csv", contents("answers.csv"), answers),
        "answers, NPZ": (".npz", contents("answers.npz"), answers),
        "image, EXR": (".exr", contents("image.exr"), equal),
    }


def scene_parsers(folder):
    """Return the parsers of scenes and meshes, as `render` and `scene export` read them, up to the first sample.

    The folder has a false plugin for every word of the good scenes: loading one is an error.
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

    def render_scene(path):
        """Read files of even size unchanged, and only make the film; read the others with small films, and render."""
        return render(path, SMALL if path.stat().st_size % 2 else {})

    mesh, sky = [(SCENES / "meshes" / "prism.ply").read_bytes()], [(SCENES / "lamps.exr").read_bytes()]
    return {
        "scene, XML": (".xml", scenes, render_scene),
        "scene to export, XML": (".xml", scenes, export),
        "sky, EXR": (".exr", sky, lambda path: render(folder / "sky.xml", SMALL)),
        "mesh, PLY": (".ply", mesh, lambda path: render(folder / "mesh.xml", {})),
    }


def render(path, defines):
    """Load the scene; render it if its film is small, otherwise only prepare the film."""
    import mitsuba as mi

    scene = scene_files.load_scene(path, defines)
    meshes = (mitsuba_mesh.arrays(shape) for shape in scene.shapes() if shape.is_mesh())
    if any(np.max(faces, initial=0) >= len(vertices) for vertices, faces in meshes):
        return "a face without its vertices"
    film = scene.sensors()[0].film()
    if math.prod(film.crop_size()) <= PIXELS:
        mi.render(scene, spp=1)
    else:
        film.prepare([])
    return None


def export(path):
    """Export the scene to one of the targets, which the size of the file selects."""
    plain = from_mitsuba.load(path, level=1)
    names = [name for name in targets.TARGETS if name != "povray"]  # POV-Ray supports glass and lights only
    targets.TARGETS[names[path.stat().st_size % len(names)]](plain)
    numbers = [*dataclasses.astuple(plain.camera), *(x for m in plain.materials for x in dataclasses.astuple(m))]
    return None if np.isfinite(np.hstack(numbers)).all() else "a number that is not finite"


# Tests ---------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def limited():
    """Within this context, end the process if an input hangs, and limit its address space."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + ADDRESSES, before[1]))
    faulthandler.dump_traceback_later(HANG, exit=True, file=sys.__stderr__)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        resource.setrlimit(resource.RLIMIT_AS, before)


def outcome(read, path):
    """Read an input; return "read" or "refused". AssertionError if the parser is at fault."""
    began, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        with limited():
            fault = read(path)
    except Exception as error:
        message = errors.describe(error)
        assert not message.startswith("internal error"), message
        assert not isinstance(error, ValueError) or "\n" not in str(error), f"several lines: {error}"
        assert "Error while loading plugin" not in str(error), f"a plugin of the scene's own was opened: {error}"
        fault, result = None, "refused"
    else:
        result = "read"
    assert not fault, fault
    assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) <= MEMORY
    assert time.process_time() - began < LONGEST
    return result


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("inputs")


@pytest.fixture(scope="module")
def parsers(folder):
    switch("scalar_rgb")
    return file_parsers(folder) | scene_parsers(folder)


KINDS = (
    *(f"{name}, TOML" for name in ("planar scene", "diff settings", "renderer")),
    *(f"rays, {kind}" for kind in ("CSV", "NPZ")), "answers, CSV", "answers, NPZ", "image, EXR",
    "scene, XML", "scene to export, XML", "sky, EXR", "mesh, PLY",
)  # fmt: skip


@pytest.mark.usefixtures("scalar_variant")
@pytest.mark.parametrize("name", KINDS)
def test_garbage_is_refused_in_one_line_or_read_correctly(name, parsers, folder):
    suffix, good, read = parsers[name]
    path, outcomes = folder / f"mutated{suffix}", Counter()
    for content in good:
        path.write_bytes(content)
        assert outcome(read, path) == "read"

    @given(inputs(suffix, good))
    def try_one(content):
        path.write_bytes(content)
        outcomes[outcome(read, path)] += 1

    try_one()
    assert outcomes["refused"] > 0
