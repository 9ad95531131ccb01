"""Values of a command line that need no validation, and that Typer does not validate.

For each parameter, given or not, Typer builds a validator; from 0.28 on by Pydantic, whose import takes as long as
that of NumPy. Here it does so only for values that are neither texts nor paths, nor flags, nor defaults.
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any


class PlainValues:
    """Before a class of commands among the bases of another."""

    def get_params(self, context: Any) -> list[Any]:
        """The parameters, `--help` among them."""
        found: list[Any] = super().get_params(context)  # type: ignore[misc]
        kinds = _kinds(self.callback) if getattr(self, "callback", None) else {}  # type: ignore[attr-defined]
        for each in found:
            if "process_value" not in vars(each):
                each.process_value = _plain(each, kinds.get(each.name))
        return found


def _plain(parameter: Any, kind: Any) -> Callable[[Any, Any], Any]:
    """What stands for the parameter's `process_value`, and calls it for what must be checked."""
    checked = parameter.process_value

    def process_value(context: Any, value: Any) -> Any:
        many = parameter.multiple or parameter.nargs == -1
        if value is None or (many and not value):
            if parameter.required:
                return checked(context, value)  # which says what is missing
            value = () if many else None
        elif kind in (str, Path):
            value = tuple(map(kind, value)) if many else kind(value)
        elif not (isinstance(value, bool) or value is parameter.default):
            return checked(context, value)
        return value if parameter.callback is None else parameter.callback(context, parameter, value)

    return process_value


def _kinds(function: Callable[..., object]) -> dict[str, Any]:
    """The type of each parameter, without None and without what it is a list of."""
    parameters = inspect.signature(function, eval_str=True).parameters
    return {name: _kind(each.annotation) for name, each in parameters.items()}


def _kind(annotation: Any) -> Any:
    """Path, for `Annotated[list[Path] | None, …]`."""
    if typing.get_origin(annotation) is Annotated:
        return _kind(typing.get_args(annotation)[0])
    inner = [each for each in typing.get_args(annotation) if each is not type(None)]
    return _kind(inner[0]) if len(inner) == 1 else annotation
