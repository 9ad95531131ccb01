"""A ray set through someone else's program: rays on its stdin, answers on its stdout, both as CSV."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from mi_refract.io import process_group

from .ray_set import Answers, RaySet, as_csv, parse_answers

TIMEOUT = 300.0  # seconds


def answers_of(
    command: Sequence[str],
    rays: RaySet,
    *,
    timeout: float = TIMEOUT,
    cwd: str | Path | None = None,
    env: Mapping[str, str] | None = None,
) -> Answers:
    """What `command` answers. Its stderr goes where ours goes; with it ends every process of its group.

    ValueError, one line that begins with the command: a status other than 0, answers that cannot be read, or none
    within `timeout` seconds. OSError where it cannot be started.
    """
    if not command:
        raise ValueError("no command; accepted: mi-refract rays run [OPTIONS] -- COMMAND")
    name = shlex.join(command)
    try:
        ended = process_group.run(command, as_csv(rays).encode(), timeout, cwd=cwd, env=env)
    except TimeoutError:
        raise ValueError(f"{name}: no answer within {timeout:g} s; accepted: a longer --timeout") from None
    except OSError as error:
        raise type(error)(f"{name}: cannot be started: {error.strerror or error}") from None
    if ended.status:
        raise ValueError(f"{name}: {ended.how}; accepted: status 0")
    return parse_answers(ended.out, name)
