"""JUnit's XML, and text that is safe in XML and on a terminal.

Names of files and messages of errors may hold any character; `printable` makes them safe to print and to write.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree as xml

from mi_refract.io.atomic import write_atomically

UNPRINTABLE = re.compile("[^\x20-\x7e\xa0-\u2027\u202f-\u2065\u206a-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class Case:
    """One test case; `outcome` "" means that it passed.

    `group`: what JUnit calls its class. `kind`: the type of a failure or an error. `message` is one line; `details`
    are the lines below it.
    """

    group: str
    name: str
    outcome: Literal["", "failure", "error", "skipped"] = ""
    message: str = ""
    details: Sequence[str] = ()
    kind: str = ""


def printable(text: Any) -> str:
    """The text on one line; each character that XML 1.0, UTF-8 or a terminal would not show becomes U+FFFD.

    Those are control characters (line ends and terminal escapes among them), surrogates, and marks that change the
    direction of writing.
    """
    return UNPRINTABLE.sub("\ufffd", str(text))


def write_junit(path: str | Path, name: str, suites: Mapping[str, Sequence[Case]]) -> None:
    """Write the suites, by name, each with the number of its cases and how they ended; `name` is that of the whole.

    Errors: OSError.
    """
    root = xml.Element("testsuites", name=printable(name))
    for title, cases in suites.items():
        suite = xml.SubElement(root, "testsuite", {"name": printable(title)} | _counts(cases))
        for case in cases:
            _append(suite, case)
    root.attrib |= _counts([case for cases in suites.values() for case in cases])
    xml.indent(root)
    document: bytes = xml.tostring(root, encoding="utf-8", xml_declaration=True)
    write_atomically(path, document + b"\n")


def _counts(cases: Sequence[Case]) -> dict[str, str]:
    ends = Counter(case.outcome for case in cases)
    counts = {"failures": ends["failure"], "errors": ends["error"], "skipped": ends["skipped"]}
    return {key: str(count) for key, count in ({"tests": len(cases)} | counts).items()}


def _append(suite: xml.Element, case: Case) -> None:
    element = xml.SubElement(suite, "testcase", classname=printable(case.group), name=printable(case.name))
    if case.outcome:
        kind = {"type": printable(case.kind)} if case.kind else {}
        end = xml.SubElement(element, case.outcome, kind | {"message": printable(case.message)})
        end.text = "\n".join(map(printable, case.details)) or None
