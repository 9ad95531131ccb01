"""Errors of tables that users write: one line with the path of the key, its value, and what was expected."""

from typing import Annotated, Any, Literal

import msgspec
import pytest
from msgspec import Meta

from mi_refract.io.typed_table import convert, key_table


class Ball(msgspec.Struct, forbid_unknown_fields=True, tag_field="kind", tag="ball"):
    """A round thing."""

    radius: Annotated[float, Meta(gt=0)] = 1.0


class Box(msgspec.Struct, forbid_unknown_fields=True, tag_field="kind", tag="box"):
    """A thing with corners."""

    colour: Literal["red", "blue"] | None = None


class Room(msgspec.Struct, forbid_unknown_fields=True):
    """Things."""

    things: list[Ball | Box] = []
    named: dict[str, Box] = {}
    size: Annotated[int, Meta(ge=1, le=9)] | Annotated[list[Annotated[float, Meta(gt=0)]], Meta(min_length=2)] = 1


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ({"thing": []}, "unknown key `thing`; expected things, named, size"),
        (
            {"things": [{"kind": "ball"}, {"kind": "box", "radius": 1}]},
            "things[1]: unknown key `radius`; expected colour",
        ),
        ({"things": [{"kind": "cone"}]}, "things[0].kind: invalid value 'cone'; expected ball, box"),
        (
            {"things": [{"kind": "box", "colour": "green"}]},
            "things[0].colour: invalid enum value 'green'; expected blue, red",
        ),
        ({"named": {"a": {"kind": "box", "colour": 1}}}, "named[...].colour: a whole number; expected text"),
        ({"named": {"a": {"kind": "box", "colour": "x"}}}, "named[...].colour: invalid enum value 'x'"),
        ({"named": {"a": {"kind": "box", "x": 1}}}, "named[...]: unknown key `x`"),
        ({"things": [{"kind": "ball", "radius": True}]}, "things[0].radius: true or false; expected a number"),
        ({"things": [{"kind": "ball", "radius": 10**400}]}, "things[0].radius: number out of range"),
        ({"things": [{"kind": "ball", "radius": float("nan")}]}, "things[0].radius: nan; expected a finite number"),
        ({"things": [{"kind": "ball", "radius": "\ud800"}]}, "a text with half of a surrogate pair; expected Unicode"),
        ({"size": 0}, "size: expected a whole number >= 1"),
        ({"size": 10**400}, "size: expected a whole number <= 9"),
        ({"size": [1.0]}, "size: expected a list [ … ] of length >= 2"),
        ({"size": [1.0, 0.0]}, "size[1]: expected a number > 0.0"),
        ({"size": [1.0, float("inf")]}, "size[1]: inf; expected a finite number"),
    ],
)
def test_errors_say_what_was_expected(table: dict[str, Any], expected: str) -> None:
    for _ in range(100):  # msgspec 0.22 frees a wrong pointer of some unions, which shows after many calls
        with pytest.raises(ValueError) as error:
            convert(table, Room, "room.toml")
        assert str(error.value) == f"room.toml: {expected}"


def test_keys_are_described_in_words() -> None:
    class Thing(msgspec.Struct):
        place: Annotated[tuple[float, float], Meta(description="where it is")]
        colour: Literal["red", "blue"] | None = None
        sizes: Annotated[tuple[Annotated[int, Meta(ge=1, le=9)], ...], Meta(description="of its parts")] = (3,)
        named: dict[str, Ball] = {}

    assert key_table("key", Thing).splitlines() == [
        "| key | type | meaning |",
        "|---|---|---|",
        "| `place` | [number, number] | where it is |",
        "| `colour` | `blue`, `red` |  |",
        "| `sizes` | list of whole number ≥ 1, ≤ 9 | of its parts; default [3] |",
        "| `named` | table |  |",
    ]
