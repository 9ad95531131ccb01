"""TOML and JSON tables that users write, converted to `msgspec.Struct`s, with checks of keys, types and limits.

A field of a struct is a key. Its annotation is the type, `Annotated[float, Meta(gt=0), doc("…")]` adds limits
and the meaning, and a default makes it optional. The documentation's tables of keys are generated from these structs.
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
_WORDS_OF_TYPES = {  # msgspec's types in words
    "str": "text",
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "array": "a list [ … ]",
    "object": "a table { … }",
    "null": "nothing",
}
_TYPES = "`((?:{0})(?: [|] (?:{0}))*)`".format("|".join(_WORDS_OF_TYPES))


def parse_toml(text: str | bytes, kind: type[T], where: str, *, infinite: bool = False) -> T:
    """Return the TOML as a value of type `kind`. ValueError for invalid TOML, and the errors of `convert`."""
    try:
        document = tomllib.loads(text if isinstance(text, str) else text.decode())
    except RecursionError:
        raise ValueError(f"{where}: brackets nested too deeply; expected TOML") from None
    except ValueError as error:
        raise ValueError(f"{where}: {error}{_line_of_error(text, str(error))}; expected TOML") from None
    return convert(document, kind, where, infinite=infinite)


def _line_of_error(text: str | bytes, error: str) -> str:
    """Return the line of an error of `tomllib`, with a hint if it has a frequent mistake; "" without a line number."""
    if not (match := re.search(r"at line (\d+)", error)):
        return ""
    line = (text if isinstance(text, str) else text.decode()).split("\n")[int(match[1]) - 1].strip()
    mistakes = {
        r"(?<![\w.])\.\d|\d\.(?!\d)": "numbers have a digit on either side of the point, as 0.8 and 1.0",
        r"=\s*[A-Za-z_]": "text is in quotes; true and false are in lower case",
    }
    hints = [hint for mistake, hint in mistakes.items() if re.search(mistake, line)]
    return ": ".join(["", line[:80], *hints[:1]])


def convert(value: Any, kind: type[T], where: str, *, infinite: bool = False) -> T:
    """Return a tree of dicts and lists as a value of type `kind`; `infinite`: numbers may be infinite, but never NaN.

    ValueError is one line: `where`, the path of the key, its value or type, and what was expected.
    """
    try:
        _check_finite(value, "$", infinite)
        return msgspec.convert(value, kind)
    except UnicodeEncodeError:  # JSON can contain single surrogates
        raise ValueError(f"{where}: a text with half of a surrogate pair; expected Unicode") from None
    except msgspec.ValidationError as error:
        message, _, path = str(error).partition(" - at `")
        path = path.removesuffix("`")
        key = re.sub(r"^(key` in `)?\$\.?", "", path)
        message = f"{message[0].lower()}{message[1:]}".replace("object contains unknown field", "unknown key")
        message = message.replace(r"matching regex '\\S'", "that is not blank").replace(" | null`", "`")
        if message.startswith("expected "):
            message = re.sub(_TYPES, lambda x: " or ".join(_WORDS_OF_TYPES[n] for n in x[1].split(" | ")), message)
            message = re.sub(r"(.*), got (\D+)", r"\2; \1", message)
            message = re.sub(r"^(a table .*a list \[ … \])", r"\1 of tables, [[…]] in TOML", message)
        if missing := re.fullmatch(r"object missing required field `(\w+)`", message):
            path = f"{path or '$'}.{missing[1]}"
        if missing or message.startswith(("unknown key", "invalid ")):
            names = _accepted_names(kind, value, path)
            message += f"; expected {', '.join(names)}" if names else ""
        raise ValueError(" ".join(f"{where}: {f'{key}: ' if key else ''}{message}".split())) from None


def _accepted_names(kind: Any, value: Any, path: str) -> list[str]:
    """Return the names that msgspec accepts at a path: keys of a table, or words. Empty if unknown."""
    types = _alternatives(msgspec.inspect.type_info(kind))
    for index, name in re.findall(r"\[([^]]*)\]|\.([^.[]+)", path):
        if name and (tags := [option.tag for option in types if getattr(option, "tag_field", None) == name]):
            return tags
        if name:
            fields = [field for struct in _structs(types, value) for field in struct.fields]
            next_types = [field.type for field in fields if field.encode_name == name]
        else:
            next_types = [option.item_type for option in types if hasattr(option, "item_type")]
        types = [option for next_type in next_types for option in _alternatives(next_type)]
        if isinstance(value, dict):
            value = value.get(name)  # None for "...", which msgspec writes in place of a name that a user chose
        else:
            value = value[int(index)] if isinstance(value, list) and index else None
    words = [str(word) for option in types for word in getattr(option, "values", ())]
    return words or [field.encode_name for struct in _structs(types, value) for field in struct.fields]


def _alternatives(kind: Any) -> list[Any]:
    """Return the members of a union, or the type itself, without its description."""
    if isinstance(kind, msgspec.inspect.Metadata):
        return _alternatives(kind.type)
    return list(kind.types) if isinstance(kind, msgspec.inspect.UnionType) else [kind]


def _structs(types: list[Any], value: Any) -> list[Any]:
    """Return the struct types that fit a table `value`, by its tag if they have one."""
    if not isinstance(value, dict):
        return []
    structs = [option for option in types if isinstance(option, msgspec.inspect.StructType)]
    return [struct for struct in structs if struct.tag_field is None or struct.tag == value.get(struct.tag_field)]


def _check_finite(value: Any, path: str, infinite: bool) -> None:
    if isinstance(value, float) and not math.isfinite(value) and not (infinite and math.isinf(value)):
        raise msgspec.ValidationError(f"Expected a {'' if infinite else 'finite '}number, got {value} - at `{path}`")
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, item in items:
            _check_finite(item, f"{path}[{key}]" if isinstance(value, list) else f"{path}.{key}", infinite)


def doc(meaning: str) -> msgspec.Meta:
    """Return the annotation that gives a key its meaning in the documentation."""
    return msgspec.Meta(description=meaning)


def key_table(title: str, kind: type[msgspec.Struct], shared: type[msgspec.Struct] = msgspec.Struct) -> str:
    """Return a Markdown table of the keys of a struct that `shared` lacks: name, type with limits, meaning, default."""
    rows = [f"| `{name}` | {type_text} | {meaning} |" for name, type_text, meaning in _keys(kind, shared)]
    return "\n".join([f"| {title} | type | meaning |", "|---|---|---|", *rows])


def key_list(title: str, kind: type[msgspec.Struct], shared: type[msgspec.Struct] = msgspec.Struct) -> str:
    """Return the content of `key_table` as lines of up to 80 columns, for a terminal."""
    lines = textwrap.wrap(title, 80)
    for key, type_text, meaning in _keys(kind, shared):
        lines += textwrap.wrap(f"  {key:14}{meaning} ({type_text})", 80, subsequent_indent=" " * 16)
    return "\n".join(lines)


def _keys(kind: type[msgspec.Struct], shared: type[msgspec.Struct] = msgspec.Struct) -> list[tuple[str, str, str]]:
    """Return name, type, and meaning with the default, of each key that `shared` lacks."""
    keys = []
    for field in msgspec.inspect.type_info(kind).fields:  # type: ignore[attr-defined]
        schema, field_type = {}, field.type
        if isinstance(field_type, msgspec.inspect.Metadata):
            schema, field_type = field_type.extra_json_schema or {}, field_type.type
        value = list(field.default) if isinstance(field.default, tuple) else field.default
        unset = value in (None, "", [], msgspec.NODEFAULT, msgspec.UNSET)
        default = "" if unset else f"; default {json.dumps(value).replace('Infinity', 'inf')}"
        keys.append((field.encode_name, _type_text(field_type), f"{schema.get('description', '')}{default}"))
    return [key for key in keys if key not in _keys(shared)]


_WORDS = {"Str": "text", "Float": "number", "Int": "whole number", "Bool": "true or false", "Dict": "table"}
_LIMITS = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}


def _type_text(kind: Any) -> str:
    """Return a type in words, e.g. `number > 0` or `list of texts`."""
    name = type(kind).__name__.removesuffix("Type")
    if name == "Union":
        texts = (_type_text(member) for member in kind.types if not isinstance(member, msgspec.inspect.NoneType))
        return " or ".join(dict.fromkeys(texts))
    if name == "Literal":
        return ", ".join(f"`{value}`" for value in kind.values)
    if name in ("List", "VarTuple"):
        return f"list of {_type_text(kind.item_type)}"
    if name == "Tuple":
        return f"[{', '.join(map(_type_text, kind.item_types))}]"
    limits = [f"{sign} {value:.9g}" for key, sign in _LIMITS.items() if (value := getattr(kind, key, None)) is not None]
    return " ".join([_WORDS.get(name, "table"), ", ".join(limits)]).strip()
