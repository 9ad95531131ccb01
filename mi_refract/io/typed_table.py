"""Tables that users write, TOML or JSON, as `msgspec.Struct`s: unknown keys, types and limits are checked on the way.

A field of a struct is a key: its annotation is the type, `Annotated[float, Meta(gt=0, description="…")]` adds limits
and what the key means, its default makes it optional. The documentation's tables of keys come from the same structs.
Do not put a `pattern` for texts into a union with a list: msgspec 0.22 then frees a wrong pointer at exit.
"""

from __future__ import annotations

import json
import math
import re
import textwrap
import tomllib
from typing import Any, TypeVar

import msgspec

T = TypeVar("T")
_PLAIN = {  # msgspec's types, for readers
    "str": "text",
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "array": "a list [ … ]",
    "object": "a table { … }",
    "null": "nothing",
}
_TYPES = "`((?:{0})(?: [|] (?:{0}))*)`".format("|".join(_PLAIN))


def parse_toml(text: str | bytes, kind: type[T], where: str, *, infinite: bool = False) -> T:
    """The value of type `kind` that the TOML holds. ValueError as of `convert`, or for what is not TOML."""
    try:
        document = tomllib.loads(text if isinstance(text, str) else text.decode())
    except RecursionError:
        raise ValueError(f"{where}: brackets nested too deeply; expected TOML") from None
    except ValueError as error:
        raise ValueError(f"{where}: {error}{_line_in_doubt(text, str(error))}; expected TOML") from None
    return convert(document, kind, where, infinite=infinite)


def _line_in_doubt(text: str | bytes, error: str) -> str:
    """The line that the error of `tomllib` names, and what is often forgotten there."""
    if not (place := re.search(r"at line (\d+)", error)):
        return ""
    line = (text if isinstance(text, str) else text.decode()).split("\n")[int(place[1]) - 1].strip()
    slips = {
        r"(?<![\w.])\.\d|\d\.(?!\d)": "numbers have a digit on either side of the point, as 0.8 and 1.0",
        r"=\s*[A-Za-z_]": "text is in quotes; true and false are in lower case",
    }
    return ": ".join(["", line[:80], *(hint for slip, hint in slips.items() if re.search(slip, line))][:3])


def convert(value: Any, kind: type[T], where: str, *, infinite: bool = False) -> T:
    """A tree of dicts and lists as a value of type `kind`; `infinite`: numbers may be.

    ValueError is one line: `where`, the path of the key, what it is, what was expected. NaN is refused.
    """
    try:
        _check_finite(value, "$", infinite)
        return msgspec.convert(value, kind)
    except UnicodeEncodeError:  # of JSON, which can spell half a character
        raise ValueError(f"{where}: a text with half of a surrogate pair; expected Unicode") from None
    except msgspec.ValidationError as error:
        message, _, path = str(error).partition(" - at `")
        path = path.removesuffix("`")
        key = re.sub(r"^(key` in `)?\$\.?", "", path)
        message = f"{message[0].lower()}{message[1:]}".replace("object contains unknown field", "unknown key")
        message = message.replace(r"matching regex '\\S'", "that is not blank").replace(" | null`", "`")
        if message.startswith("expected "):
            message = re.sub(_TYPES, lambda types: " or ".join(map(_PLAIN.__getitem__, types[1].split(" | "))), message)
            message = re.sub(r"(.*), got (\D+)", r"\2; \1", message)
            message = re.sub(r"^(a table .*a list \[ … \])", r"\1 of tables, [[…]] in TOML", message)
        if missing := re.fullmatch(r"object missing required field `(\w+)`", message):
            path = f"{path or '$'}.{missing[1]}"
        if (missing or message.startswith(("unknown key", "invalid "))) and (names := _names(kind, value, path)):
            message = f"{message}; expected {', '.join(names)}"
        raise ValueError(" ".join(f"{where}: {f'{key}: ' if key else ''}{message}".split())) from None


def _names(kind: Any, value: Any, path: str) -> list[str]:
    """What may stand at the path where msgspec found another name: keys of a table, or words. Empty where unknown."""
    kinds = _alternatives(msgspec.inspect.type_info(kind))
    for index, name in re.findall(r"\[([^]]*)\]|\.([^.[]+)", path):
        if name and (tags := [each.tag for each in kinds if getattr(each, "tag_field", None) == name]):
            return tags
        if name:
            types = [
                field.type for each in _structs(kinds, value) for field in each.fields if field.encode_name == name
            ]
        else:
            types = [each.item_type for each in kinds if hasattr(each, "item_type")]
        kinds = [each for one in types for each in _alternatives(one)]
        if isinstance(value, dict):
            value = value.get(name)  # None of the dots that msgspec writes for a name that a user chose
        else:
            value = value[int(index)] if isinstance(value, list) and index else None
    words = [str(word) for each in kinds for word in getattr(each, "values", ())]
    return words or [field.encode_name for each in _structs(kinds, value) for field in each.fields]


def _alternatives(kind: Any) -> list[Any]:
    """The members of a union, or the type itself, without its description."""
    if isinstance(kind, msgspec.inspect.Metadata):
        return _alternatives(kind.type)
    return list(kind.types) if isinstance(kind, msgspec.inspect.UnionType) else [kind]


def _structs(kinds: list[Any], value: Any) -> list[Any]:
    """The types that describe this table."""
    structs = [each for each in kinds if isinstance(each, msgspec.inspect.StructType) and isinstance(value, dict)]
    return [each for each in structs if each.tag_field is None or each.tag == value.get(each.tag_field)]


def _check_finite(value: Any, path: str, infinite: bool) -> None:
    if isinstance(value, float) and not math.isfinite(value) and not (infinite and math.isinf(value)):
        raise msgspec.ValidationError(f"Expected a {'' if infinite else 'finite '}number, got {value} - at `{path}`")
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, item in items:
            _check_finite(item, f"{path}[{key}]" if isinstance(value, list) else f"{path}.{key}", infinite)


def key_table(title: str, kind: type[msgspec.Struct], shared: type[msgspec.Struct] = msgspec.Struct) -> str:
    """A Markdown table of the keys of a struct that `shared` has not: name, type with its limits, meaning, default."""
    rows = [f"| `{name}` | {accepted} | {meaning} |" for name, accepted, meaning in _keys(kind, shared)]
    return "\n".join([f"| {title} | type | meaning |", "|---|---|---|", *rows])


def key_list(title: str, kind: type[msgspec.Struct], shared: type[msgspec.Struct] = msgspec.Struct) -> str:
    """The same in lines of up to 80 columns, for a terminal."""
    lines = textwrap.wrap(title, 80)
    for key, accepted, meaning in _keys(kind, shared):
        lines += textwrap.wrap(f"  {key:14}{meaning} ({accepted})", 80, subsequent_indent=" " * 16)
    return "\n".join(lines)


def _keys(kind: type[msgspec.Struct], shared: type[msgspec.Struct] = msgspec.Struct) -> list[tuple[str, str, str]]:
    """Name, type, and meaning with the default, of each key that `shared` has not."""
    keys = []
    for field in msgspec.inspect.type_info(kind).fields:  # type: ignore[attr-defined]
        described = isinstance(field.type, msgspec.inspect.Metadata)
        schema = field.type.extra_json_schema or {} if described else {}
        bare = field.type.type if described else field.type
        value = list(field.default) if isinstance(field.default, tuple) else field.default
        unset = value in (None, "", [], msgspec.NODEFAULT, msgspec.UNSET)
        default = "" if unset else f"; default {json.dumps(value).replace('Infinity', 'inf')}"
        keys.append((field.encode_name, _type_text(bare), f"{schema.get('description', '')}{default}"))
    return [key for key in keys if key not in _keys(shared)]


_WORDS = {"Str": "text", "Float": "number", "Int": "whole number", "Bool": "true or false", "Dict": "table"}
_LIMITS = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}


def _type_text(kind: Any) -> str:
    """A type as a reader of the table understands it, e.g. `number > 0` or `list of texts`."""
    name = type(kind).__name__.removesuffix("Type")
    if name == "Union":
        texts = (_type_text(each) for each in kind.types if not isinstance(each, msgspec.inspect.NoneType))
        return " or ".join(dict.fromkeys(texts))
    if name == "Literal":
        return ", ".join(f"`{value}`" for value in kind.values)
    if name in ("List", "VarTuple"):
        return f"list of {_type_text(kind.item_type)}"
    if name == "Tuple":
        return f"[{', '.join(_type_text(each) for each in kind.item_types)}]"
    limits = [f"{sign} {value:.9g}" for key, sign in _LIMITS.items() if (value := getattr(kind, key, None)) is not None]
    return " ".join([_WORDS.get(name, "table"), ", ".join(limits)]).strip()
