"""The JSON files of the pack as structs, which give their schemas; every file is checked against them."""

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
    """Rays of one precision, their certified answers, and the limits of answers."""

    u: Annotated[float, _doc("unit roundoff: half an ulp of 1")]
    rays: Annotated[list[str], _doc("the same rays in two formats")]
    certified: Annotated[list[str], _doc("the exact answers with the limits of each ray, in two formats")]
    checksum: Annotated[str, _doc("of the rays, as in their header")]
    regimes: Annotated[dict[str, tuple[int, int]], _doc("first and last id of each regime")]
    error_bound: Annotated[str, _doc("the formula whose error bound gives angle_limit, length_limit, decided")]
    backward_error_limit: Annotated[float, _doc("in u: of direction, decision and length of a right answer")]


class Limits(_Strict):
    """rays/limits.json."""

    columns: Annotated[dict[str, str], _doc("meaning of the columns of certified answers")]
    precisions: dict[str, RaysOfPrecision]


class ReferenceImage(_Strict):
    """How a reference image was made."""

    scene: Annotated[str, _doc("the file that was rendered, with -D bsdf=refract")]
    spp: Annotated[int, _doc("samples per pixel; divide NAME.variance by it for the variance of the pixel")]
    seed: int
    relative_rmse: Annotated[float, _doc("noise: root of the mean variance of a pixel, over the mean of the image")]


class StandardNumber(_Strict):
    """A row of numbers/standard_numbers.json."""

    name: str
    kind: Annotated[str, _doc("the quantity")]
    unit: Annotated[str, _doc("°, mm or empty")]
    value: Annotated[float, _doc("by the law, rounded once")]
    printed: Annotated[str, _doc("as printed in the source; empty if it prints no value")]
    printed_value: float | None
    printed_half_unit: Annotated[float | None, _doc("half a unit of the last printed digit")]
    given: Annotated[dict[str, float], _doc("the parameters of the law; angles in degrees, wavelengths in nm")]
    law: str
    source: str
    fitted: Annotated[str, _doc("which parameter was fitted to what; empty if none was")]
    off_print: Annotated[float | None, _doc("value − printed_value")]


class Sky(_Strict):
    """The sky: one of the two keys."""

    environment: Annotated[str, _doc("the file of a latitude-longitude map")] = ""
    radiance: Colour = (0.0, 0.0, 0.0)


class Glass(_Strict, tag="glass", tag_field="type"):
    """A smooth boundary; triangles are counterclockwise seen from the medium of ext_ior."""

    int_ior: float
    ext_ior: float


class Diffuse(_Strict, tag="diffuse", tag_field="type"):
    """A Lambertian surface, the same from both sides."""

    reflectance: Colour


class Light(_Strict, tag="light", tag_field="type"):
    """A surface that emits on the side from which its triangles are counterclockwise; the back is black."""

    radiance: Colour


class Object(_Strict):
    """An object of scene.obj, and its material."""

    object: str
    material: str


class Scene(_Strict):
    """scene.json beside scene.obj."""

    name: str
    max_depth: Annotated[int, _doc("the most segments of a path from the camera")]
    camera: Camera
    sky: Sky
    materials: dict[str, Glass | Diffuse | Light]
    meshes: dict[str, Object]


# Pattern of paths → name of the schema, and type.
KINDS: dict[str, tuple[str, Any]] = {
    INDEX: ("index", PackIndex),
    "rays/limits.json": ("limits", Limits),
    "images/images.json": ("images", dict[str, ReferenceImage]),
    "numbers/standard_numbers.json": ("standard_numbers", list[StandardNumber]),
    "scenes/*/scene.json": ("scene", Scene),
}


def schema_path(path: str) -> str:
    """Return the path or URL of a JSON file's schema; "" for other files. ValueError for a JSON file without one."""
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
    """Raise msgspec.ValidationError if a JSON file does not conform to its schema."""
    for pattern, (_, kind) in KINDS.items():
        if fnmatch(path, pattern):
            msgspec.json.decode(content, type=kind)


def schemas() -> dict[str, bytes]:
    """Return the files of all schemas, by path."""
    return {
        f"schemas/{name}.schema.json": json_text({"$schema": DRAFT} | msgspec.json.schema(kind), 1).encode() + b"\n"
        for name, kind in KINDS.values()
    }
