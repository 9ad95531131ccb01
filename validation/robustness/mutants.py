"""Mutants of our own code: every place where cosmic-ray would change a line, and a sample of them.

A mutant is one operator at one place. The sample draws places first, and then one mutant of each: a binary operator has
eleven replacements, most of which are errors of type, and would be every second mutant. Cosmic-ray leaves strings and
docstrings alone; its two operators that draw random numbers are not used. Left out is what cannot change what a module
does: annotations, `__all__`, blocks under `if TYPE_CHECKING`; and what does not compile.
"""

from __future__ import annotations

import ast
import hashlib
import random
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

ROOMS = ("plugins", "image_diff", "ray_sets", "accuracy", "scene_export")
# By the first word of an operator's name: the only nodes that it changes. To ask all takes five times as long.
NODES = {
    "ReplaceBinaryOperator": ("operator",),
    "ReplaceComparisonOperator": ("comparison",),
    "ReplaceUnaryOperator": ("factor", "not_test"),
}


@dataclass(frozen=True)
class Mutant:
    """The `occurrence`-th place in `path` where `operator` applies; `line` becomes another one there."""

    path: str  # from the root: "mi_refract/plugins/refract.py"
    operator: str
    occurrence: int
    number: int  # of the line
    line: str
    becomes: str

    @property
    def room(self) -> str:
        """The package that it is in."""
        return Path(self.path).parts[1]

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What stays the same when other lines come and go."""
        return self.path, self.operator, self.line, self.becomes

    def __str__(self) -> str:
        """Where it is, and what changes."""
        return f"{self.path}:{self.number}: {self.operator}: {self.line} → {self.becomes}"


def sample(root: Path, count: int, seed: int) -> list[Mutant]:
    """The first `count` useful mutants of all places, shuffled: a smaller sample begins a larger one.

    The order is that of a hash of the seed, the file and the text of the line: an edit changes what is drawn from the
    lines that it changes, and nothing else.
    """
    drawn = [(_key(seed, path, *name), path, place) for path in files(root) for name, place in _places(root / path)]
    found: list[Mutant] = []
    for key, path, place in sorted(drawn):
        if len(found) == count:
            break
        if mutant := of(root, path, *random.Random(key).choice(place)):
            found.append(mutant)
    return found


def _key(*parts: object) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def files(root: Path) -> list[str]:
    """The modules of the five packages, in order."""
    paths = [path for room in ROOMS for path in sorted((root / "mi_refract" / room).rglob("*.py"))]
    return [path.relative_to(root).as_posix() for path in paths]


def of(root: Path, path: str, operator: str, occurrence: int) -> Mutant | None:
    """The mutant; None where it does not compile, or cannot change what the module does."""
    source = (root / path).read_text("utf-8")
    changed = mutated(source, operator, occurrence)
    try:
        if _behaviour(changed) == _behaviour(source):
            return None
    except SyntaxError:
        return None
    return Mutant(path, operator, occurrence, *_changed_line(source, changed, operator))


def mutated(source: str, operator: str, occurrence: int) -> str:
    """The source after the mutation. Errors: ValueError where there is no such place."""
    from cosmic_ray.mutating import mutate_code

    changed = mutate_code(source, operators()[operator], occurrence)
    if changed is None:
        raise ValueError(f"{operator} does not apply {occurrence + 1} times")
    return str(changed)


def every(root: Path, path: str) -> Iterator[Mutant]:
    """All useful mutants of one file."""
    for _, place in _places(root / path):
        for operator, occurrence in place:
            if mutant := of(root, path, operator, occurrence):
                yield mutant


def lines(root: Path, path: str) -> set[str]:
    """The lines of a file as mutants name them."""
    return {_plain(text) for text in (root / path).read_text("utf-8").splitlines()}


def _places(path: Path) -> list[tuple[tuple[Any, ...], list[tuple[str, int]]]]:
    """Names of the places, and operators and occurrences at each; a place belongs to one family of operators.

    A name has the text of the line, the columns, the family, and how often all this came before in the file.
    """
    nodes, text = _nodes(path), path.read_text("utf-8").splitlines()
    found: dict[tuple[Any, ...], list[tuple[str, int]]] = {}
    for operator in operators():
        for occurrence, start in enumerate(_starts(operator, nodes)):
            found.setdefault((start, operator.partition("_")[0]), []).append((operator, occurrence))
    before: Counter[tuple[Any, ...]] = Counter()
    named = []
    for key in sorted(found):
        ((line, column), family) = key
        name = (text[line - 1].strip(), column, family)
        named.append(((*name, before[name]), found[key]))
        before[name] += 1
    return named


def _nodes(path: Path) -> list[Any]:
    """Of cosmic-ray's tree of a file, in the order in which it counts."""
    from cosmic_ray.ast import ast_nodes, get_ast

    return list(ast_nodes(get_ast(path.read_text("utf-8"))))


def _starts(operator: str, nodes: list[Any]) -> list[tuple[int, int]]:
    """Line and column of every place where an operator applies."""
    kinds = NODES.get(operator.partition("_")[0])
    positions = operators()[operator].mutation_positions
    return [start for node in nodes if kinds is None or node.type in kinds for start, _ in positions(node)]


@cache
def operators() -> dict[str, Any]:
    """Cosmic-ray's operators by name, but for those that need arguments and draw random numbers."""
    from cosmic_ray.operators.provider import OperatorProvider

    provider = OperatorProvider()
    return {name: provider[name]() for name in sorted(provider) if not provider[name].arguments()}


def _changed_line(source: str, changed: str, operator: str) -> tuple[int, str, str]:
    """Number and text of the first line that differs, and what it becomes: "" where it is a decorator, and gone."""
    old, new = source.splitlines(), changed.splitlines()
    index = next(i for i, (a, b) in enumerate(zip_longest(old, new)) if a != b)
    becomes = new[index]
    if operator == "RemoveDecorator":  # with the empty lines above it
        index = next(i for i in range(index, len(old)) if old[i].lstrip().startswith("@"))
        becomes = ""
    return index + 1, _plain(old[index]), _plain(becomes)


def _plain(line: str) -> str:
    return " ".join(line.split())


class _Behaviour(ast.NodeTransformer):
    """Takes out of a module what cannot change what it does."""

    def visit_arg(self, node: ast.arg) -> ast.arg:
        """No annotation."""
        node.annotation = None
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        """No annotation of what it returns."""
        node.returns = None
        return self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        """A name in place of the annotation, which dataclasses ask for but do not read."""
        node.annotation = ast.Name("annotation")
        return self.generic_visit(node)

    def visit_If(self, node: ast.If) -> ast.AST | None:
        """No imports for annotations."""
        return None if "TYPE_CHECKING" in ast.dump(node.test) else self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> ast.AST | None:
        """No list of public names."""
        return None if ast.unparse(node.targets[0]) == "__all__" else self.generic_visit(node)


def _behaviour(source: str) -> str:
    return ast.dump(_Behaviour().visit(ast.parse(source)))
