"""The settings file `mi-refract.toml`, and options in words: what they may hold, and how they are read.

[defaults]
method = "tolerance"
accept = ["{stem}-*.exr"]

[[image]]
name = "glass/caustic*.exr"
fail = 0.02
reason = "single-precision caustic: last bits differ between processors"
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from mi_refract.io.toml_schema import TABLES, TEXT, Key, Type, first_of, key_table, list_of, read, table, text

from . import idiff_flags, name_patterns
from .channels import Names
from .methods import AUTO, METHODS, options_of_auto
from .settings import PROCESSORS, SYSTEMS, TOLERANCE, ComparisonSpec, Entry, Map, Settings, all_options

FILE = "mi-refract.toml"
ACCEPTED = (AUTO, *METHODS)
WORDS = tuple(dict.fromkeys((*SYSTEMS.values(), *PROCESSORS.values())))
SIDES = 4  # numbers of a rectangle


def _finite_or_inf(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value) if value == value else None
    except OverflowError:
        return None


def _template(names: Collection[str]) -> Type:
    """Paths that may hold these fields."""
    shown = ", ".join(f"{{{name}}}" for name in names)
    return Type(
        f"a path that may hold {shown}",
        lambda value: value if isinstance(value, str) and name_patterns.is_template(value, names) else None,
    )


def _rectangles(value: Any) -> tuple[tuple[int, ...], ...] | None:
    found = list_of(list_of(lambda x: x if type(x) is int else None, SIDES, SIDES))(value)
    return tuple(map(tuple, found)) if found and all(min(x[2:]) > 0 for x in found) else None


def channels_of(value: Any) -> Names | None:
    """The names of channels of the reference and of the new image, from a list or a table; None for anything else."""
    table = {name: name for name in value if text(name)} if isinstance(value, list) else value
    if not isinstance(table, dict) or not table or len(table) != len(value):
        return None
    known = all(text(each) for pair in table.items() for each in pair)
    return tuple(table.items()) if known and len(set(table.values())) == len(table) else None


def _platforms(value: Any) -> tuple[str, ...] | None:
    found = [value] if isinstance(value, str) else value
    known = list_of(lambda each: each if text(each) and _platform(each.split()) else None)(found)
    return tuple(known) if known else None


def _platform(words: list[str]) -> bool:
    """Whether there may be one that is all of it: one system, one processor."""
    known = set(words) <= set(WORDS)
    return known and all(len(set(words) & set(kind.values())) <= 1 for kind in (SYSTEMS, PROCESSORS))


BOOL = Type("true or false", lambda value: value if isinstance(value, bool) else None)
METHOD = Type(", ".join(ACCEPTED), lambda value: value if isinstance(value, str) and value in ACCEPTED else None)
TEMPLATE = _template(name_patterns.FIELDS)
BESIDE = _template(("stem", "name", "suffix"))
MASK = _template(("root", *name_patterns.FIELDS))
TEMPLATES = Type(f"a list, each {BESIDE.accepted}, and *", list_of(BESIDE.parse))
RECTANGLES = Type("a list of [x, y, width, height], in pixels", _rectangles)
PLATFORM = Type(f"of {', '.join(WORDS)}: one, two words, or a list of such", _platforms)
CHANNELS = Type("a list of channels, or a table { <of the reference> = <of the new image>, … }", channels_of)
MAP = Type("{ reference = …, test = … } or a list of such", first_of(table, list_of(table)))

ANY_TEXT = Type("a text", lambda value: value if isinstance(value, str) else None)
IDIFF = {"idiff": Key(ANY_TEXT, "flags of OpenImageIO's `idiff`, as they stand; the method is `tolerance`", None)}
EVERYWHERE = {
    "method": Key(METHOD, "the method; that of the command line by default", None),
    "allow_nonfinite": Key(BOOL, "whether NaN or Inf is allowed where the other image has the same", None),
    "accept": Key(TEMPLATES, "other references beside it, each as good; from the reference's own path", None),
    "mask": Key(
        MASK, "an image beside the reference in which white counts, black does not; {root}: their folder", None
    ),
    "variance": Key(
        MASK, "an image of the variance of one sample of each pixel, beside each side's own; {root}: their folder", None
    ),
    "channels": Key(CHANNELS, "those that are compared; X, Y, Z are made of R, G, B where an image has none", None),
    "ignore": Key(RECTANGLES, "rectangles of pixels that do not count", None),
}
DEFAULTS = EVERYWHERE | {
    "map": Key(MAP, "templates of the paths of references and new images; without it, both have the same path", None)
}
IMAGE = {
    "name": Key(TEXT, "the image's path inside its folder; `*` stands for anything, `/` included, `?` for a character"),
    "reason": Key(TEXT, "why this image is not compared like the others"),
    "when": Key(PLATFORM, "the platforms that this is for; all by default", None),
    "skip": Key(BOOL, "whether it is not compared", None),
} | EVERYWHERE
TYPES: dict[type, Type] = {
    float: Type("a number or inf", _finite_or_inf),
    int: Type("a whole number", lambda value: value if type(value) is int else None),
    str: TEXT,
}


def load(path: str | Path, default: ComparisonSpec = ComparisonSpec(), allow_nonfinite: Sequence[str] = ()) -> Settings:  # noqa: B008
    """The settings of a file, with `default` and `allow_nonfinite` from the command line.

    An entry with a name that is wrong in anything else is kept with its error: its images cannot be compared, the
    others can. ValueError names the file and the key for whatever else is wrong; OSError as the system raises it.
    """
    import tomllib  # where there is a file: it compiles its patterns

    path = Path(path)
    try:
        document = tomllib.loads(path.read_bytes().decode())
        top = read(document, {"defaults": Key(Type("a table", table), "", {}), "image": Key(TABLES, "", [])})
        defaults, maps = _defaults(top["defaults"])
        rules = tuple(_entry(each, f"image[{i}]", str(path)) for i, each in enumerate(top["image"]))
    except (ValueError, RecursionError) as error:
        said = str(error) if isinstance(error, ValueError) else "brackets nested too deeply; expected TOML"
        raise ValueError(" ".join(f"{path}: {said}".split())) from None
    return Settings(default, rules, tuple(allow_nonfinite), defaults, maps)


def _defaults(given: dict[str, Any]) -> tuple[Entry, tuple[Map, ...]]:
    values = _values(given, DEFAULTS, "defaults.")
    found = values.pop("map", [])
    return Entry("*", values, "defaults"), tuple(map(_map, [found] if isinstance(found, dict) else found))


def _map(given: dict[str, Any]) -> Map:
    values = read(given, {side: Key(TEMPLATE, "") for side in ("reference", "test")}, "defaults.map.")
    one, two = (name_patterns.fields_of(values[side]) for side in ("reference", "test"))
    if one != two or not one or "*" in values["reference"] + values["test"]:
        raise ValueError("defaults.map; expected the same fields in `reference` and `test`, and no `*`")
    return Map(**values)


def _entry(given: dict[str, Any], where: str, path: str) -> Entry:
    name = read({"name": given["name"]} if "name" in given else {}, {"name": IMAGE["name"]}, f"{where}.")["name"]
    try:
        values = _values(given, IMAGE, f"{where}.")
    except ValueError as error:
        return Entry(name, {}, where, error=" ".join(f"{path}: {error}".split()))
    when = values.pop("when", ())
    return Entry(name, {key: value for key, value in values.items() if key != "name"}, where, when)


def _values(given: dict[str, Any], keys: dict[str, Key], where: str) -> dict[str, Any]:
    """The values of the keys that are given. Options are those of the method where there is one, else of any."""
    method = read({k: v for k, v in given.items() if k == "method"}, {"method": EVERYWHERE["method"]}, where)["method"]
    values = read(given, keys | (IDIFF if method in (None, TOLERANCE) else {}) | keys_of(method), where)
    values = {key: tuple(values[key]) if key == "accept" else values[key] for key in given}
    if "idiff" not in given:
        return values
    try:
        return {**idiff_flags.parse(values["idiff"]).options, "method": TOLERANCE, **values}
    except ValueError as error:
        raise ValueError(f"{where}idiff: {error}") from None


def keys_of(method: str | None) -> dict[str, Key]:
    """The options of a method as keys; of all methods for None, of those that "auto" chooses from for that."""
    if method is None:
        every = [keys_of(name) for name in METHODS]
        return {name: _any_of([keys[name] for keys in every if name in keys]) for name in sorted(all_options())}
    options = options_of_auto() if method == AUTO else METHODS[method].options
    return {name: Key(TYPES[option.type], option.help, option.default) for name, option in options.items()}


def _any_of(keys: list[Key]) -> Key:
    """A key of a name that several methods have; each checks it again."""
    kinds = list(dict.fromkeys(key.type for key in keys))
    one = Type(" or ".join(kind.accepted for kind in kinds), first_of(*(kind.parse for kind in kinds)))
    return Key(one, keys[0].meaning, keys[0].default)


def channels_from(words: str) -> Names:
    """The channels of the command line: names, or REFERENCE=TEST, between commas. ValueError for anything else."""
    parts = [each.strip() for each in words.split(",")]
    pairs = [
        (one.strip(), two.strip() if equals else one.strip()) for one, equals, two in (p.partition("=") for p in parts)
    ]
    if (found := channels_of(dict(pairs))) is None or len(found) != len(pairs):
        raise ValueError(f"--channels {words}; expected distinct names, or REFERENCE=TEST, between commas")
    return found


def variance_from(words: str) -> str:
    """The template of the command line's `--variance`. ValueError for what is none."""
    if MASK.parse(words) is None:
        raise ValueError(f"--variance {words}; expected {MASK.accepted}")
    return words


def from_words(method: str, words: Sequence[str], idiff: str | None = None) -> ComparisonSpec:
    """The method and its options from the command line's `NAME=VALUE` and `--idiff`. ValueError for anything else."""
    if method not in ACCEPTED:
        raise ValueError(f"--method {method}; expected {METHOD.accepted}")
    if idiff is not None:
        return _from_idiff(method, words, idiff)
    keys = keys_of(method)
    given: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or name in given:
            raise ValueError(f"--set {word}; expected NAME=VALUE, each name once")
        given[name] = _value(value, keys[name].type) if name in keys else value
    values = read(given, keys, "--set ")
    return ComparisonSpec(method, {name: values[name] for name in given})


def _from_idiff(method: str, words: Sequence[str], flags: str) -> ComparisonSpec:
    if method not in (AUTO, TOLERANCE):
        raise ValueError(f"--idiff with --method {method}; accepted with --method {TOLERANCE}, or alone")
    try:
        given = idiff_flags.parse(flags).options
    except ValueError as error:
        raise ValueError(f"--idiff: {error}") from None
    return ComparisonSpec(TOLERANCE, {**given, **from_words(TOLERANCE, words).options}, idiff=flags)


def _value(value: str, kind: Type) -> Any:
    """A number where the option is one; the text itself where that fails, for `read` to refuse."""
    for numeric in (int, float) if kind is not TEXT else ():
        try:
            return numeric(value)
        except ValueError:
            continue
    return value


def reference() -> str:
    """What a settings file may hold, and the options of each method, in Markdown."""
    parts = [key_table("`[defaults]`", DEFAULTS | IDIFF), key_table("`[[image]]`", IMAGE | IDIFF)]
    for name, method in METHODS.items():
        parts.append(f"`{name}`: {method.summary}")
        parts += [key_table("option", keys_of(name))] if keys_of(name) else []
    return "\n\n".join(parts)
