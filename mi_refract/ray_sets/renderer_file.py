"""`mi-refract-renderer.toml`: a renderer's refraction, how to run it, and what is known of it. See README.md here.

Whoever has the folder of such a file can ask the renderer: `mi-refract rays run --renderer FOLDER`.
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mi_refract.io import regular_file
from mi_refract.io.toml_schema import (
    TABLES,
    TEXT,
    TEXTS,
    Key,
    Table,
    Type,
    key_table,
    list_of,
    number,
    only_if,
    positive,
    read,
    shown,
    table,
)

from .header import PRECISIONS
from .tir_signal import AUTO, TIR

NAME = "mi-refract-renderer.toml"
SIZE = 2**20  # bytes: a file of more is none
ANY = Type("a table", table)
FLAG = Type("true or false", lambda value: value if isinstance(value, bool) else None)
RENDERER = {
    "title": Key(TEXT, "name of the renderer, as reports show it"),
    "licence": Key(TEXT, "its licence", None),
    "rays": Key(TABLES, "[[rays]]: functions that answer rays", None),
    "images": Key(ANY, "[images]: how it renders a scene", None),
    "lens": Key(TEXTS, "a command that traces a lens, for the study `lenses`", None),
    "install": Key(ANY, "[install]: what brings it; of the renderers of this project only", None),
}
RAYS = {
    "title": Key(TEXT, "name of the function, as reports show it"),
    "precision": Key(Type("f32 or f64", lambda x: x if x in PRECISIONS else None), "the precision that it claims"),
    "command": Key(TEXTS, "reads rays on stdin and writes answers to stdout, as CSV; runs in the file's folder"),
    "total_internal_reflection": Key(
        Type(", ".join((AUTO, *TIR)), lambda x: x if x in (AUTO, *TIR) else None),
        "how the function signals total internal reflection",
        AUTO,
    ),
    "gives_up": Key(
        Type("a number from 0", only_if(lambda x: x >= 0, number)),
        "rays with cos²θ_t below this are taken for totally reflected, by the renderer's documentation",
        0.0,
    ),
    "lengths": Key(TEXT, "what it does with vectors that are not unit", None),
    "remark": Key(TEXT, "what else is known of it", None),
    "recorded": Key(
        ANY, "the largest angle in radians of an earlier run by set of rays: a number, or [from, to]", None
    ),
    "deviation": Key(TABLES, "[[rays.deviation]]: regimes in which it is known to be wrong, and why", None),
}
DEVIATION = {"regime": Key(TEXT, "a regime, or a set of rays of the study"), "reason": Key(TEXT, "why")}
IMAGES = {
    "export": Key(TEXT, "a target of `mi-refract scene export`"),
    "command": Key(TEXTS, "renders {scene}, with {spp} samples a pixel and the seed {seed}, into {image}"),
    "spp": Key(ANY, "samples a pixel by scene; other scenes are not asked"),
    "assumed": Key(TEXTS, "in what its model differs", None),
    "deviation": Key(ANY, "scenes on which it is known to differ, and why", None),
}


@dataclass(frozen=True)
class RaysCommand:
    """A function of refraction. `command` is as in the file, with its placeholders; `deviations`: reasons by regime."""

    title: str
    precision: str
    command: tuple[str, ...]
    tir: str = AUTO
    gives_up: float = 0.0
    lengths: str = ""
    remark: str = ""
    recorded: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    deviations: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ImagesCommand:
    """How a renderer renders. `spp`: by scene; `deviations`: reasons by scene."""

    export: str
    command: tuple[str, ...]
    spp: Mapping[str, int]
    assumed: tuple[str, ...]
    deviations: Mapping[str, str]


@dataclass(frozen=True)
class RendererFile:
    """A renderer. `install`: the table as it is in the file; None where there is none."""

    folder: Path
    title: str
    licence: str
    rays: tuple[RaysCommand, ...]
    images: ImagesCommand | None
    lens: tuple[str, ...]
    install: Table | None

    @property
    def name(self) -> str:
        """That of its folder."""
        return self.folder.resolve().name


def load(folder: str | Path) -> RendererFile:
    """The renderer of a folder. ValueError, one line that names file and key; OSError where there is no such file."""
    path = Path(folder) / NAME
    content = regular_file.read_bytes(path, SIZE)
    try:
        return _renderer(Path(folder), read(tomllib.loads(content.decode()), RENDERER))
    except RecursionError:
        raise ValueError(f"{path}: brackets nested too deeply; expected TOML") from None
    except ValueError as error:  # also of TOML and UTF-8
        raise ValueError(" ".join(f"{path}: {error}".split())) from None


def filled(command: tuple[str, ...], **values: object) -> list[str]:
    """A command with its placeholders filled in; {python} is this interpreter and {environment} "." unless given.

    ValueError for a placeholder that is unknown.
    """
    known = {"python": sys.executable, "environment": "."} | values
    try:
        return [word.format_map({name: str(value) for name, value in known.items()}) for word in command]
    except (KeyError, IndexError, ValueError, AttributeError) as error:
        accepted = ", ".join(f"{{{name}}}" for name in known)
        raise ValueError(f"command: {' '.join(command)}: {error}; expected {accepted}") from None


def reference() -> str:
    """All keys as tables in Markdown."""
    tables = {"key": RENDERER, "of `[[rays]]`": RAYS, "of `[[rays.deviation]]`": DEVIATION, "of `[images]`": IMAGES}
    return "\n\n".join(key_table(title, keys) for title, keys in tables.items())


def _renderer(folder: Path, values: Table) -> RendererFile:
    rays = tuple(_rays(each, f"rays[{i}].") for i, each in enumerate(values["rays"] or []))
    images = _images(values["images"]) if values["images"] is not None else None
    if not rays and images is None and values["install"] is None:  # of some, scripts render the images
        raise ValueError("rays: missing; expected [[rays]], [images] or both")
    titles = [f"{each.title}, {each.precision}" for each in rays]
    if repeated := {title for title in titles if titles.count(title) > 1}:
        raise ValueError(f"rays: {repeated.pop()!r} is there twice; expected a title for each function")
    return RendererFile(
        folder, values["title"], values["licence"] or "", rays, images, tuple(values["lens"] or ()), values["install"]
    )


def _rays(given: Table, where: str) -> RaysCommand:
    values = read(given, RAYS, where)
    deviations = [read(each, DEVIATION, f"{where}deviation[{i}].") for i, each in enumerate(values["deviation"] or [])]
    filled(tuple(values["command"]))
    return RaysCommand(
        title=values["title"],
        precision=values["precision"],
        command=tuple(values["command"]),
        tir=values["total_internal_reflection"],
        gives_up=values["gives_up"],
        lengths=values["lengths"] or "",
        remark=values["remark"] or "",
        recorded={name: _range(x, f"{where}recorded.{name}") for name, x in (values["recorded"] or {}).items()},
        deviations={each["regime"]: each["reason"] for each in deviations},
    )


def _range(value: Any, where: str) -> tuple[float, float]:
    pair = list_of(positive, 2, 2)(value if isinstance(value, list) else [value, value])
    if pair is None or pair[0] > pair[1]:
        raise ValueError(f"{where}: {shown(value)}; expected a number above 0, or [from, to]")
    return pair[0], pair[1]


def _images(given: Table) -> ImagesCommand:
    values = read(given, IMAGES, "images.")
    for scene, spp in values["spp"].items():
        if type(spp) is not int or spp < 1:
            raise ValueError(f"images.spp.{scene}: {shown(spp)}; expected a whole number above 0")
    deviations = values["deviation"] or {}
    for scene, reason in deviations.items():
        if TEXT.parse(reason) is None:
            raise ValueError(f"images.deviation.{scene}: {shown(reason)}; expected the reason, a text")
    filled(tuple(values["command"]), scene="", spp=0, seed=0, image="")
    return ImagesCommand(
        values["export"],
        tuple(values["command"]),
        values["spp"],
        tuple(values["assumed"] or ()),
        deviations,
    )
