"""Each room says what it is for and what it offers; other rooms import nothing else of it."""

from __future__ import annotations

import ast
import importlib
import importlib.util
from collections.abc import Iterator
from pathlib import Path

import pytest

import mi_refract

PACKAGE = Path(mi_refract.__file__).parent
ROOMS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))


def offered(room: str) -> list[str]:
    """`__all__` of a room."""
    return list(getattr(importlib.import_module(f"mi_refract.{room}"), "__all__", []))


def imported(own: str, source: str) -> Iterator[tuple[int, str, str]]:
    """Line, room and first name below the room of every import of another room in the source of room `own`."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        for name in names:
            package, room, member, *_ = [*name.split("."), "", ""]
            if package == "mi_refract" and room in ROOMS and room != own:
                yield node.lineno, room, member


def test_other_rooms_import_only_what_a_room_offers() -> None:
    lists = {room: offered(room) for room in ROOMS}
    foreign = [
        f"{path.relative_to(PACKAGE.parent)}:{line}: mi_refract.{room}.{member} is private to its room"
        for path in sorted(PACKAGE.rglob("*.py"))
        for line, room, member in imported(path.relative_to(PACKAGE).parts[0], path.read_text("utf-8"))
        if room in lists and member and member not in lists[room]
    ]
    assert not foreign, "\n".join(foreign)


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_says_what_it_is_for_and_what_it_offers(room: str) -> None:
    module = importlib.import_module(f"mi_refract.{room}")
    assert len((module.__doc__ or "").splitlines()) > 1
    assert offered(room)
    for name in offered(room):
        assert hasattr(module, name) or importlib.util.find_spec(f"mi_refract.{room}.{name}"), f"{room} has no {name}"


# Dataclasses that are filled while something is done; all others are results, and nobody may change them.
FILLED = {"Hit", "LightPath", "LongRender", "LoopState", "PassSums", "PathState"}
FILLED |= {"Progress", "Ray", "Scatter", "SearchState", "Start", "Tally"}


def test_results_are_frozen() -> None:
    found = [
        (node.name, "frozen=True" in decorator)
        for path in sorted(PACKAGE.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.ClassDef)
        for decorator in map(ast.unparse, node.decorator_list)
        if decorator.startswith("dataclass")
    ]
    assert len(found) > 50
    assert {name for name, frozen in found if not frozen} == FILLED
