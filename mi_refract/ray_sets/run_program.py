"""A program's answers to a ray set: it reads rays from stdin and writes answers to stdout, both as CSV."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from mi_refract.io import process_group
from mi_refract.io.errors import TooMuchOutputError

from .files import as_csv, most_answers, parse_answers
from .ray_set import Answers, RaySet
from .tables import csv_bytes

TIMEOUT = 300.0  # seconds


def answers_of(
    command: Sequence[str],
    rays: RaySet,
    *,
    timeout: float = TIMEOUT,
    cwd: str | Path | None = None,
    env: Mapping[str, str] | None = None,
) -> Answers:
    """The answers of `command`, which has `timeout` seconds. Its stderr is passed through.

    Every process of its group is ended with it. ValueError, one line that begins with the command, where it ends with
    another status than 0, answers too late, prints no answers, or more than two for each ray need. OSError where it
    cannot be started.
    """
    if not command:
        raise ValueError("no command; expected mi-refract rays run [OPTIONS] -- COMMAND")
    name = shlex.join(command)
    if not 0 <= timeout <= process_group.LONGEST:
        raise ValueError(f"--timeout {timeout:g}; expected 0 … {process_group.LONGEST:g} seconds")
    most = csv_bytes(most_answers(rays))
    try:
        ended = process_group.run(command, as_csv(rays).encode(), timeout, cwd=cwd, env=env, most=most)
    except TooMuchOutputError as error:
        raise ValueError(f"{name}: {error}; expected one answer a ray") from None
    except TimeoutError:
        raise ValueError(f"{name}: did not finish within {timeout:g} s; set a longer --timeout") from None
    except OSError as error:
        raise type(error)(f"{name}: cannot be started: {error.strerror or error}") from None
    if ended.status:
        raise ValueError(f"{name}: {ended.describe}; expected status 0")
    return parse_answers(ended.out, name)
