"""The JSON files of the pack as structs, of which their schemas are written; what does not fit is not packed."""

from __future__ import annotations

from fnmatch import fnmatch
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from mi_refract.io.reference_pack import INDEX, PackIndex
from mi_refract.io.text import json_text
from mi_refract.scene_export.plain_scene import Camera

Colour = Annotated[tuple[float, float, float], Meta(description="linear R, G, B of Rec. 709")]
DRAFT = "https://json-schema.org/draft/2020-12/schema"


def _doc(meaning: str) -> Meta:
    return Meta(description=meaning)


class _Strict(msgspec.Struct, forbid_unknown_fields=True):
    pass


class RaysOfPrecision(_Strict):
    """Rays of one precision, what certifies them, and the limits of answers."""

    u: Annotated[float, _doc("roundoff: half an ulp of 1")]
    rays: Annotated[list[str], _doc("the same rays in two formats")]
    certified: Annotated[list[str], _doc("the exact answers with the limits of each ray, in two formats")]
    checksum: Annotated[str, _doc("of the rays, as their header has it")]
    regimes: Annotated[dict[str, tuple[int, int]], _doc("first and last id of each regime")]
    error_bound: Annotated[str, _doc("the formula whose error bound gives angle_limit, length_limit, decided")]
    backward_error_limit: Annotated[float, _doc("in u, of direction, decision and length of an answer that is right")]


class Limits(_Strict):
    """rays/limits.json."""

    columns: Annotated[dict[str, str], _doc("what the columns of certified answers are")]
    precisions: dict[str, RaysOfPrecision]


class ReferenceImage(_Strict):
    """How a reference image was made."""

    scene: Annotated[str, _doc("the file that was rendered, with -D bsdf=refract")]
    spp: Annotated[int, _doc("samples per pixel; divide NAME.variance by it for the variance of the pixel")]
    seed: int
    relative_rmse: Annotated[float, _doc("of the noise: root of the mean variance of a pixel, over the mean")]


class StandardNumber(_Strict):
    """A row of numbers/standard_numbers.json."""

    name: str
    kind: Annotated[str, _doc("what is asked")]
    unit: Annotated[str, _doc("°, mm or empty")]
    value: Annotated[float, _doc("by the law, rounded once")]
    printed: Annotated[str, _doc("as the source has it; empty where nothing is printed")]
    printed_value: float | None
    printed_half_unit: Annotated[float | None, _doc("half of its last digit")]
    given: Annotated[dict[str, float], _doc("all that the law needs; angles in degrees, wavelengths in nm")]
    law: str
    source: str
    fitted: Annotated[str, _doc("what was fitted to what; empty where all is given")]
    off_print: Annotated[float | None, _doc("value − printed_value")]


class Sky(_Strict):
    """One of the two keys."""

    environment: Annotated[str, _doc("the file of a map by longitude and latitude")] = ""
    radiance: Colour = (0.0, 0.0, 0.0)


class Glass(_Strict, tag="glass", tag_field="type"):
    """A smooth boundary; triangles are counterclockwise as seen from the medium of ext_ior."""

    int_ior: float
    ext_ior: float


class Diffuse(_Strict, tag="diffuse", tag_field="type"):
    """A Lambertian surface, the same from both sides."""

    reflectance: Colour


class Light(_Strict, tag="light", tag_field="type"):
    """A surface that emits where its triangles are counterclockwise, and is black from behind."""

    radiance: Colour


class Object(_Strict):
    """An object of scene.obj, and its material."""

    object: str
    material: str


class Scene(_Strict):
    """scene.json beside scene.obj."""

    name: str
    max_depth: Annotated[int, _doc("segments of a path from the camera")]
    camera: Camera
    sky: Sky
    materials: dict[str, Glass | Diffuse | Light]
    meshes: dict[str, Object]


# By the pattern of their paths, the name of the schema and the type.
KINDS: dict[str, tuple[str, Any]] = {
    INDEX: ("index", PackIndex),
    "rays/limits.json": ("limits", Limits),
    "images/images.json": ("images", dict[str, ReferenceImage]),
    "numbers/standard_numbers.json": ("standard_numbers", list[StandardNumber]),
    "scenes/*/scene.json": ("scene", Scene),
}


def schema_path(path: str) -> str:
    """Where the schema of a JSON file is, or a URL; "" of other files. ValueError for a JSON file without one."""
    if path.endswith(".gltf"):
        return "https://github.com/KhronosGroup/glTF/blob/main/specification/2.0/schema/glTF.schema.json"
    if path.endswith(".schema.json"):
        return DRAFT
    if not path.endswith(".json"):
        return ""
    names = [name for pattern, (name, _) in KINDS.items() if fnmatch(path, pattern)]
    if not names:
        raise ValueError(f"{path}: no schema; expected one of {', '.join(KINDS)}")
    return f"schemas/{names[0]}.schema.json"


def check(path: str, content: bytes) -> None:
    """msgspec.ValidationError where a JSON file is not what its schema says."""
    for pattern, (_, kind) in KINDS.items():
        if fnmatch(path, pattern):
            msgspec.json.decode(content, type=kind)


def schemas() -> dict[str, bytes]:
    """The files of all schemas, by path."""
    return {
        f"schemas/{name}.schema.json": json_text({"$schema": DRAFT} | msgspec.json.schema(kind), 1).encode() + b"\n"
        for name, kind in KINDS.values()
    }
