"""What the reference says of the program, in Markdown, read from the program: docstrings, structs, its own help.

Docstrings here are Markdown, which `sphinx.ext.autodoc` does not read.
"""

import enum
import functools
import importlib
import inspect
import operator
import pkgutil
import re
import types
import typing
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import msgspec

import mi_refract
from mi_refract import media
from mi_refract.image_diff import settings
from mi_refract.io.typed_table import key_table
from mi_refract.planar import scene_file
from mi_refract.ray_sets import header, renderer_file

MOST_LINES = 4  # of a comment that is shown
LONGEST = 100  # characters of a value that is shown


def docstring(name: str) -> str:
    """Of a module."""
    return inspect.getdoc(importlib.import_module(name)) or ""


# Python ---------------------------------------------------------------------------------------------------------------


def pages() -> dict[str, str]:
    """The pages of the rooms, by their paths; the commands have a page of their own."""
    rooms = [module.name for module in pkgutil.iter_modules(mi_refract.__path__) if module.name != "cli"]
    return {
        f"reference/python/{room}.md": f"# mi_refract.{room}\n\n```{{generated}} room mi_refract.{room}\n```\n"
        for room in rooms
    }


def room(name: str) -> str:
    """A room's docstring, its public names with theirs, and the public names of its public modules."""
    module = importlib.import_module(name)
    offered = {x: getattr(module, x, None) for x in getattr(module, "__all__", ())} or own(module)
    names = {x: value for x, value in offered.items() if value is not None and not inspect.ismodule(value)}
    modules = [importlib.import_module(f"{name}.{x}") for x in offered if x not in names]
    parts = section(module, names)
    for below in modules:
        more = {x: value for x, value in own(below).items() if value not in names.values()}
        parts += [f"## {below.__name__.rpartition('.')[2]}", *section(below, more)]
    return "\n\n".join(parts)


def section(module: ModuleType, names: dict[str, Any]) -> list[str]:
    """The docstring of a module, and these names of it."""
    head = [f"```{{py:module}} {module.__name__}\n```", inspect.getdoc(module) or ""]
    return head + [described(name, value, module) for name, value in names.items()]


def own(module: ModuleType) -> dict[str, Any]:
    """The public functions and classes that a module defines, in its order."""
    public = {name: value for name, value in vars(module).items() if not name.startswith("_") and callable(value)}
    return {name: x for name, x in public.items() if getattr(x, "__module__", "") == module.__name__}


def described(name: str, value: Any, module: ModuleType) -> str:
    """One name as a directive of Sphinx's Python domain."""
    if inspect.isclass(value) and value.__module__.startswith("mi_refract"):
        members = [x for x in vars(value).items() if x[0] == "__call__" or not x[0].startswith("_")]
        parts = [inspect.getdoc(value) or "", *(member(key, x) for key, x in members)]
        if issubclass(value, msgspec.Struct):  # a table that users write or read
            parts.insert(1, key_table("key", value, value.__base__))
        kind, text = "class", "\n\n".join(filter(None, parts))
    elif inspect.isroutine(value) or isinstance(value, functools._lru_cache_wrapper):
        kind, text = "function", inspect.getdoc(value) or ""
    else:
        kind, text = "data", constant(name, value, module)
    return f"````````{{py:{kind}}} {name}{signature(value)}\n{text}\n````````"


def member(name: str, value: Any) -> str:
    """A documented method or property, or a value of an enumeration; nothing for other members of a class."""
    if isinstance(value, enum.Enum):
        return f"``````{{py:attribute}} {name}\n``````"
    plain = value.__func__ if isinstance(value, (classmethod, staticmethod)) else value
    kind = "method" if inspect.isfunction(plain) else "property" if hasattr(plain, "__get__") else ""
    text = inspect.getdoc(plain)
    if not kind or not text or type(plain).__name__ in ("member_descriptor", "_tuplegetter"):
        return ""
    return f"``````{{py:{kind}}} {name}{signature(plain)}\n{text}\n``````"


class Named:
    """A default that has no literal, by its name."""

    def __init__(self, value: Any) -> None:
        """`value`: the default."""
        self.name = getattr(value, "__name__", "...")

    def __repr__(self) -> str:
        """Valid Python, which Sphinx parses."""
        return self.name if self.name.isidentifier() else "..."


def plain_type(annotation: Any) -> Any:
    """A type without the constraints of `Annotated`."""
    if hasattr(annotation, "__metadata__"):
        return plain_type(annotation.__origin__)
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union:
        return functools.reduce(operator.or_, map(plain_type, typing.get_args(annotation)))
    return annotation


def signature(value: Any) -> str:
    """As it is called; nothing for what is not."""
    from sphinx.util.inspect import stringify_signature

    if not callable(value) or (inspect.isclass(value) and issubclass(value, (enum.Enum, msgspec.Struct))):
        return ""
    try:
        found = inspect.signature(value)
    except (TypeError, ValueError):
        return ""
    parameters = [
        x.replace(default=Named(x.default)) if repr(x.default)[:1] == "<" and x.default is not x.empty else x
        for x in (y.replace(annotation=plain_type(y.annotation)) for y in found.parameters.values())
        if x.name not in ("self", "cls")
    ]
    returns = inspect.Signature.empty if inspect.isclass(value) else found.return_annotation
    return stringify_signature(found.replace(parameters=parameters, return_annotation=returns))


def constant(name: str, value: Any, module: ModuleType) -> str:
    """The comment at its definition, and its value, or the keys of a table."""
    if isinstance(value, dict):
        shown = f"Keys: {', '.join(f'`{key}`' for key in value)}."
    else:
        shown = f"Value: `{value!r}`." if len(repr(value)) < LONGEST and repr(value)[0] != "<" else ""
    return f"{comment(name, module)}\n\n{shown}"


def comment(name: str, module: ModuleType) -> str:
    """What stands above or behind `NAME = …` in the room."""
    paths = getattr(module, "__path__", None)
    names = [f"{module.__name__}.{x.name}" for x in pkgutil.iter_modules(paths)] if paths else [module.__name__]
    for source in map(inspect.getsource, map(importlib.import_module, names)):
        if found := re.search(rf"((?:^# .*\n)*)^{name}\b[^=\n]*=[^#\n]*(?:# (.*))?$", source, re.MULTILINE):
            above = [line.removeprefix("# ") for line in found[1].splitlines() if "fmt:" not in line]
            text = found[2] or " ".join(above if len(above) <= MOST_LINES else ())
            return text[:1].upper() + text[1:].removesuffix(".") + "." * bool(text)
    return ""


# The command line -----------------------------------------------------------------------------------------------------


def commands() -> str:
    """Every command with what its `--help` says."""
    import typer

    from mi_refract.cli import app

    return "\n\n".join(command("mi-refract", typer.main.get_command(app.app)))


def command(name: str, one: Any) -> Iterator[str]:
    """The sections of a command and of those below it."""
    context = one.context_class(one, info_name=name)
    if " " in name:
        yield f"## `{name}`" if name.count(" ") == 1 else f"### `{name}`"
    yield escaped(inspect.cleandoc(one.help or ""))
    yield f"```text\n{one.get_usage(context).removeprefix('Usage: ')}\n```"
    records = [record for parameter in one.get_params(context) if (record := parameter.get_help_record(context))]
    if records:
        rows = [f"| {code(option)} | {escaped(text)} |" for option, text in records if option != "--help"]
        yield "\n".join(["| argument or option | meaning |", "|---|---|", *rows]) if rows else ""
    if lines := [line.strip() for line in (one.epilog or "").splitlines() if line.startswith("  ")]:
        yield "Examples:\n\n```bash\n" + "\n".join(lines) + "\n```"
    for below in one.list_commands(context) if hasattr(one, "list_commands") else ():
        yield from command(f"{name} {below}", one.get_command(context, below))


def code(text: str) -> str:
    """As code in a cell of a table."""
    return "`" + text.replace("|", r"\|") + "`"


def escaped(text: str) -> str:
    """Plain text as Markdown that may stand in a table: what is not in backticks means itself."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(x.replace("|", r"\|") if x[:1] == "`" else re.sub(r"([*_<|\[\]])", r"\\\1", x) for x in parts)


# Files that users write -----------------------------------------------------------------------------------------------


def planar_keys() -> str:
    """The keys of a planar scene."""
    parts = [key_table("key", scene_file.SceneTable)]
    for title, kind, listed in scene_file.SHARED:
        parts += [f"## {title.replace('[[shape]]', '`[[shape]]`')}", "Beside its kind and the keys of that kind:"]
        parts.append(key_table("key", kind, listed))
    for table, kinds in (("shape", scene_file.AnyShape), ("beam", scene_file.AnyBeam)):
        parts.append(f"## `[[{table}]]`")
        for kind in kinds.__args__:
            about = (inspect.getdoc(kind) or "").partition("\n")[0]
            parts += [f'### `kind = "{kind.__struct_config__.tag}"`', about, key_table("key", kind, scene_file.Solid)]
    return "\n\n".join(parts)


def renderer_keys() -> str:
    """The keys of a renderer's file."""
    return renderer_file.reference()


def rays_keys() -> str:
    """The keys of the header of a file of rays."""
    return key_table("key", header.RaysHeader)


def diff_keys() -> str:
    """The keys of a settings file of `diff`, and the options of each method."""
    return settings.key_tables()


# Materials ------------------------------------------------------------------------------------------------------------

WRONG = 1e-3  # more than temperature and purity make
KNOWN = {  # materials of Mitsuba's table that are in ours
    "vacuum": "1",
    "air": "AIR:ciddor",
    "water": "MATERIAL:water",
    "fused quartz": "MATERIAL:fused-silica",
    "bk7": "SCHOTT:N-BK7",
    "diamond": "MATERIAL:diamond",
}


def mitsuba_names() -> list[str]:
    """The names that Mitsuba knows, which its error for another one lists."""
    try:
        media.parse("?")
    except ValueError as error:
        return str(error).partition("expected ")[2].split(", ")
    raise AssertionError("Mitsuba knows the material `?`")


def materials() -> str:
    """Mitsuba's names with their indices, and those of the materials at the d line."""
    rows = ["| name | index | at the d line | of | off by |", "|---|---|---|---|---|"]
    for name in mitsuba_names():
        index = media.index(name, media.LINES["d"])
        row = f"| `{name}` | {index:.7g} |"
        if name not in KNOWN:
            rows.append(f"{row} – | – | – |")
            continue
        true = media.index(KNOWN[name], media.LINES["d"])
        off = f"{index - true:+.4f}".replace("-", "−")
        rows.append(f"{row} {true:.5f} | `{KNOWN[name]}` | {f'**{off}**' if abs(index - true) > WRONG else off} |")
    return "\n".join(rows)


WRITERS = {
    function.__name__: function
    for function in (docstring, room, commands, planar_keys, renderer_keys, rays_keys, diff_keys, materials)
}
