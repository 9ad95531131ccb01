"""`mi-refract-renderer.toml`: a renderer's functions of refraction, how to run them, and their known deviations.

`mi-refract rays run --renderer FOLDER` checks the renderer whose folder contains this file. See its how-to page.
"""

from __future__ import annotations

import sys
from pathlib import Path
from string import Formatter
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from mi_refract.io import safe_files
from mi_refract.io.typed_table import doc, key_table, parse_toml

NAME = "mi-refract-renderer.toml"
SIZE = 2**20  # largest size of the file in bytes
Text = Annotated[str, Meta(min_length=1)]
Command = Annotated[tuple[Text, ...], Meta(min_length=1)]


class Deviation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A regime in which a function is known to be wrong."""

    regime: Annotated[Text, doc("a regime, or a set of rays of the study")]
    reason: Annotated[Text, doc("the reason")]


class RaysCommand(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A function of refraction. `command` contains its placeholders, as in the file."""

    title: Annotated[Text, doc("name of the function in reports")]
    precision: Annotated[Literal["f32", "f64"], doc("the precision of its answers")]
    command: Annotated[
        Command, doc("reads rays on stdin and writes answers to stdout, as CSV; runs in the file's folder")
    ]
    tir: Annotated[
        Literal["auto", "zero", "nan", "reflected", "tangent", "flag"],
        doc("how the function signals total internal reflection"),
    ] = msgspec.field(name="total_internal_reflection", default="auto")
    gives_up: Annotated[
        float,
        Meta(ge=0),
        doc("rays with cos²θ_t below this are totally reflected, according to the renderer's documentation"),
    ] = 0.0
    lengths: Annotated[str, doc("how it handles vectors that are not unit")] = ""
    remark: Annotated[str, doc("further remarks")] = ""
    recorded: Annotated[
        dict[str, float | list[float]],  # msgspec 0.22 misreads limits within a union with a list
        doc("largest angle in radians in an earlier run, by set of rays: a number, or [from, to]"),
    ] = {}
    deviation: Annotated[
        tuple[Deviation, ...], doc("`[[rays.deviation]]`: regimes in which it is known to be wrong, and why")
    ] = ()

    def __post_init__(self) -> None:
        """ValueError for an unknown placeholder, or a recorded angle that is neither a number above 0 nor a range."""
        filled(self.command)
        for name, value in self.recorded.items():
            angles = value if isinstance(value, list) else [value, value]
            if len(angles) != 2 or not 0 < angles[0] <= angles[1]:
                raise ValueError(f"recorded: {name}: {value}; expected a number above 0, or [from, to]")

    def recorded_range(self, name: str) -> tuple[float, float] | None:
        """The recorded angle of a set of rays as (from, to); None if none is recorded."""
        if (value := self.recorded.get(name)) is None:
            return None
        return (value[0], value[1]) if isinstance(value, list) else (value, value)

    @property
    def deviations(self) -> dict[str, str]:
        """The reasons of the known deviations, by regime."""
        return {deviation.regime: deviation.reason for deviation in self.deviation}


class ImagesCommand(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How to render an image with a renderer."""

    export: Annotated[Text, doc("a target of `mi-refract scene export`")]
    command: Annotated[Command, doc("renders {scene} with {spp} samples per pixel and the seed {seed} into {image}")]
    spp: Annotated[
        dict[str, Annotated[int, Meta(ge=1)]], doc("samples per pixel by scene; other scenes are not rendered")
    ]
    assumed: Annotated[tuple[Text, ...], doc("how its model differs from Mitsuba's")] = ()
    deviations: Annotated[dict[str, Text], doc("scenes on which it is known to differ, and why")] = msgspec.field(
        name="deviation", default_factory=dict
    )

    def __post_init__(self) -> None:
        """ValueError for an unknown placeholder."""
        filled(self.command, scene="", spp=0, seed=0, image="")


class RendererFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A renderer. `install` is the table of the file, unchecked."""

    title: Annotated[Text, doc("name of the renderer in reports")]
    licence: Annotated[str, doc("its licence")] = ""
    rays: Annotated[tuple[RaysCommand, ...], doc("`[[rays]]`: functions that answer rays")] = ()
    images: Annotated[ImagesCommand | None, doc("`[images]`: how it renders a scene")] = None
    lens: Annotated[tuple[Text, ...], doc("a command that traces a lens, for the study `lenses`")] = ()
    install: Annotated[
        dict[str, Any] | None, doc("`[install]`: how to install it; only for the renderers of this project")
    ] = None

    def __post_init__(self) -> None:
        """ValueError if there is nothing to run, or two functions have the same title."""
        if not self.rays and self.images is None and self.install is None:  # for some, scripts of this project render
            raise ValueError("no [[rays]] and no [images]; expected one of them, or both")
        titles = [f"{function.title}, {function.precision}" for function in self.rays]
        if repeated := [title for title in titles if titles.count(title) > 1]:
            raise ValueError(f"rays: two functions have the title {repeated[0]!r}; expected one")


def load(folder: str | Path) -> RendererFile:
    """The renderer of a folder. ValueError, one line that names file and key; OSError if the file cannot be read."""
    path = Path(folder) / NAME
    return parse_toml(safe_files.read_bytes(path, SIZE), RendererFile, str(path))


def filled(command: tuple[str, ...], **values: object) -> list[str]:
    """A command with its placeholders replaced by `values`; defaults: {python} is this interpreter, {environment} ".".

    ValueError for a placeholder that is unknown, or has a format or conversion.
    """
    known = {"python": sys.executable, "environment": "."} | values
    words = []
    for word in command:
        try:
            parts = [(text, field, spec or conversion) for text, field, spec, conversion in Formatter().parse(word)]
            if wrong := [field for _, field, spec in parts if field is not None and (spec or field not in known)]:
                raise ValueError(repr(wrong[0]))
        except ValueError as error:
            expected = ", ".join(f"{{{name}}}" for name in known)
            raise ValueError(f"command: {' '.join(command)}: {error}; expected {expected}") from None
        words.append("".join(text + (str(known[field]) if field is not None else "") for text, field, _ in parts))
    return words


def reference() -> str:
    """All keys as tables in Markdown."""
    tables: dict[str, type[msgspec.Struct]] = {
        "key": RendererFile,
        "of `[[rays]]`": RaysCommand,
        "of `[[rays.deviation]]`": Deviation,
        "of `[images]`": ImagesCommand,
    }
    return "\n\n".join(key_table(title, kind) for title, kind in tables.items())
