"""Parsing and loading of scene files, with errors in one line."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refract import SCENES
from mi_refract.io.image_file import one_line

if TYPE_CHECKING:  # they import Dr.Jit and Mitsuba
    from mi_refract.numerics import Scene
    from mi_refract.plugins.scene_parser import ParsedScene

REPRODUCIBLE: Any = {"parallel": False, "optimize": False}  # options for mi.load_file, as in `ParsedScene.load`
PIXELS = 2**26  # most pixels of an image; four channels of them are 1 GiB


def parse_defines(items: Sequence[str]) -> dict[str, str]:
    """Return values by name: `["bsdf=dielectric"]` → `{"bsdf": "dielectric"}`.

    ValueError for another syntax, or a name given twice.
    """
    defines: dict[str, str] = {}
    for item in items:
        name, equals, value = item.partition("=")
        if not equals or not re.fullmatch(r"[A-Za-z_]\w*", name):
            raise ValueError(f"-D {item}; expected NAME=VALUE")
        if name in defines:
            raise ValueError(f"-D {item}: {name} is given twice; expected once")
        defines[name] = value
    return defines


def parse_scene(path: str | os.PathLike[str], defines: Mapping[str, str] | None = None) -> ParsedScene:
    """Parse a Mitsuba scene in an XML file, for the present variant, without running any of its plugins.

    `defines`: values that replace those of its `<default>`s. FileNotFoundError for a missing file; ValueError, in one
    line, for errors of Mitsuba's parser, circular references, and pipes.
    """
    from mi_refract.plugins import scene_parser

    path, defines = Path(path), dict(defines or {})
    if not path.exists() or path.is_dir():
        ours = (SCENES / path.name).with_suffix(".xml")
        raise FileNotFoundError(f"{path}: no such scene file" + f"; the package has {ours}" * ours.is_file())
    with _in_one_line(path):
        return scene_parser.parse(path, defines)


def load_parsed(
    parsed: ParsedScene, allow_plugins: Collection[str] = (), moved: Mapping[str, str] | None = None
) -> Scene:
    """Load a parsed scene, once.

    A scene may contain plugins, which are code: only those in `allow_plugins`, Mitsuba's own and ours are loaded.
    `moved`: new paths of files, by their names in the scene. ValueError, in one line, for other plugins, errors of
    Mitsuba, a scene without a sensor or an integrator, and a film that is empty or too large.
    """
    import mitsuba as mi

    from mi_refract.plugins import check_integrator

    path = parsed.path
    with _in_one_line(path):
        scene: Any = parsed.load(allow_plugins, moved)
        if not isinstance(scene, mi.Scene):
            raise ValueError(f"{path}: contains a {type(scene).__name__}; expected a <scene>")
        if not scene.sensors():
            raise ValueError(f"{path}: the scene has no sensor; expected at least one")
        if scene.integrator() is None:
            raise ValueError(f"{path}: the scene has no integrator; expected one")
        check_integrator(scene)
        width, height = scene.sensors()[0].film().crop_size()
        if not 1 <= width * height <= PIXELS:
            raise ValueError(f"{path}: a film of {width} × {height} pixels; expected 1 to {PIXELS}")
    return scene


def load_scene(
    path: str | os.PathLike[str], defines: Mapping[str, str] | None = None, allow_plugins: Collection[str] = ()
) -> Scene:
    """Parse and load a scene file, in the present variant. Arguments and errors: of `parse_scene` and `load_parsed`."""
    return load_parsed(parse_scene(path, defines), allow_plugins)


def formulas_in(scene: Scene) -> list[str]:
    """Return the formulas of the `refract` BSDFs in a scene, sorted; "promoted (auto)" if the plugin chose it."""
    from mi_refract.plugins import all_shapes

    texts = (str(shape.bsdf()) for shape in all_shapes(scene))
    return sorted({name for text in texts for name in re.findall(r"Refract\[.*?formula = (.+?),\n", text, re.DOTALL)})


@contextlib.contextmanager
def _in_one_line(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError:
        raise
    except Exception as error:  # RuntimeError from the parser; whatever a Python plugin raises
        raise ValueError(naming(path, error)) from None


def naming(path: str | os.PathLike[str], error: Exception) -> str:
    """Return the error as one line that names the file, without the line numbers of Mitsuba's source."""
    text = re.sub(r"\[\w+\.(cpp|h):\d+\] ", "", one_line(str(error)))
    text = re.sub(r"Traceback \(most recent call last\):.* (\w+Error: )", "", text)
    return text if str(path) in text else f"{path}: {text}"
