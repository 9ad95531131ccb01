"""JUnit's XML. Names of files and messages of errors may hold any character: `printable` makes them fit for XML."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree as xml

from mi_refract.io.atomic import write_atomically
from mi_refract.io.sanitise import printable


@dataclass(frozen=True)
class Case:
    """One test case; `outcome` "" means that it passed.

    `group`: what JUnit calls its class. `kind`: the type of a failure or an error. `message` is one line; `details`
    are the lines below it, of a case that passed its output.
    """

    group: str
    name: str
    outcome: Literal["", "failure", "error", "skipped"] = ""
    message: str = ""
    details: Sequence[str] = ()
    kind: str = ""


def write_junit(path: str | Path, name: str, suites: Mapping[str, Sequence[Case]]) -> None:
    """Write the suites, by name, each with the number of its cases and how they ended; `name` is that of the whole.

    Errors: OSError.
    """
    root = xml.Element("testsuites", name=printable(name))
    for title, cases in suites.items():
        suite = xml.SubElement(root, "testsuite", {"name": printable(title)} | _counts(cases))
        for case in cases:
            element = xml.SubElement(suite, "testcase", classname=printable(case.group), name=printable(case.name))
            details = "\n".join(map(printable, case.details)) or None
            if case.outcome:
                kind = {"type": printable(case.kind)} if case.kind else {}
                xml.SubElement(element, case.outcome, kind | {"message": printable(case.message)}).text = details
            elif details:
                xml.SubElement(element, "system-out").text = details
    root.attrib |= _counts([case for cases in suites.values() for case in cases])
    xml.indent(root)
    document: bytes = xml.tostring(root, encoding="utf-8", xml_declaration=True)
    write_atomically(path, document + b"\n")


def _counts(cases: Sequence[Case]) -> dict[str, str]:
    ends = Counter(case.outcome for case in cases)
    counts = {"failures": ends["failure"], "errors": ends["error"], "skipped": ends["skipped"]}
    return {key: str(count) for key, count in ({"tests": len(cases)} | counts).items()}
