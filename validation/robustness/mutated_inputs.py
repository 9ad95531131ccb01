"""Mutated inputs: each parser reads garbage, and answers with one line, or with the right content.

Inputs are made from good ones by a seeded mutator, by turns for all parsers, and read in a process of its own with
a limit on its memory. A finding is an exception that no command would print as a line of its own, an input that takes
longer than 10 s or ends the process, twice, or content that was accepted and is not what the good input holds.

`python -m validation.robustness.mutated_inputs COUNT [SEED]` prints the counts as JSON.
"""

from __future__ import annotations

import faulthandler
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mi_refract.io import exit_code
from mi_refract.report.row import Row
from validation.run.context import Context
from validation.study import Study, Task, about

HANG = 10.0  # seconds for one input
MEMORY = 12 << 30  # bytes of address space beyond what the imports take: a reader may ask for the most it accepts
COUNTS = {"quick": 500, "standard": 10_000, "full": 50_000}
FINDINGS = ("tracebacks", "accepted garbage", "hangs or deaths")
TERMS = {
    "refused": "inputs that were answered with an error in one line",
    "read": "inputs that hold content all the same",
    "tracebacks": "exceptions that nobody expected, or errors of several lines",
    "accepted garbage": "inputs called right, equal or intact that are not",
    "hangs or deaths": "inputs that took more than 10 s, or ended the process",
}


def fuzz(count: int, seed: int = 0) -> tuple[dict[str, Counter[str]], list[dict[str, Any]]]:
    """Counts by parser, and the findings, of inputs 0 … `count` − 1. Where a process ends, the next one goes on."""
    counts: dict[str, Counter[str]] = {}
    findings: list[dict[str, Any]] = []
    first, again = 0, -1
    while first < count:
        command = [sys.executable, "-m", __spec__.name, "--child", str(seed), str(first), str(count)]
        ended = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        last = first - 1
        for line in ended.stdout.splitlines():
            said = json.loads(line)
            last = said["input"]
            counts.setdefault(said["parser"], Counter())[said["outcome"]] += 1
            if said["outcome"] in FINDINGS:
                findings.append(said)
        first = last + 1
        if first == count and not ended.returncode:
            break
        if last < 0 and not ended.stdout and "Error" in ended.stderr:
            raise ValueError(f"no input was read: {' '.join(ended.stderr.split())[-300:]}")
        if first != again:  # a machine that stood still for a while gets a second chance
            again = first
            continue
        tail = " ".join(ended.stderr.split())[-300:]
        findings.append({"input": first, "outcome": "hangs or deaths", "said": f"{ended.returncode}: {tail}"})
        counts.setdefault("any", Counter())["hangs or deaths"] += 1
        first += 1
    return counts, findings


def _child(seed: int, first: int, end: int) -> None:
    """Read the inputs; a line of JSON on stdout after each one."""
    from .parsers import parsers

    records = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # for what Mitsuba prints
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        every = list(parsers(folder).items())
        used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
        for index in range(first, end):
            parser_name, parser = every[index % len(every)]
            path = folder / f"mutated{parser.suffix}"
            path.write_bytes(parser.mutation(random.Random(f"{seed}/{index}")))
            faulthandler.dump_traceback_later(HANG, exit=True)
            outcome, said = _outcome(parser.read, path)
            faulthandler.cancel_dump_traceback_later()
            record = {"input": index, "parser": parser_name, "outcome": outcome}
            print(json.dumps(record | ({"said": said[:300]} if outcome in FINDINGS else {})), file=records, flush=True)


def _outcome(read: Any, path: Path) -> tuple[str, str]:
    try:
        wrong = read(path)
    except Exception as error:
        said = exit_code.describe(error)
        several = isinstance(error, ValueError) and "\n" in str(error)
        return ("tracebacks" if several or said.startswith("internal error") else "refused"), said
    return ("accepted garbage", wrong) if wrong else ("read", "")


def _rows(context: Context) -> list[Row]:
    count = COUNTS[context.profile.name]
    counts, findings = fuzz(count)
    rows = []
    for name, found in counts.items():
        values = {"inputs": float(found.total())} | {key: float(found[key]) for key in ("refused", "read", *FINDINGS)}
        here = [each for each in findings if each.get("parser", "any") == name]
        replay = {"seed": 0, "findings": here[:20]} if here else {"seed": 0}
        rows.append(Row(STUDY.name, name, "mutated", "", values, budgets=dict.fromkeys(FINDINGS, 0.0), replay=replay))
    return rows


STUDY = Study(
    "mutated inputs",
    "Garbage in",
    about(__doc__),
    TERMS,
    lambda context: [Task("mutated inputs", lambda: _rows(context), timed=True)],
)


def main(arguments: Sequence[str]) -> int:
    """`--child SEED FIRST END`, or `COUNT [SEED]`; 1 where there is a finding."""
    if arguments[0] == "--child":
        _child(*map(int, arguments[1:]))
        return 0
    counts, findings = fuzz(*map(int, arguments))
    print(json.dumps({"counts": counts, "findings": findings}, indent=1))
    return int(bool(findings))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
