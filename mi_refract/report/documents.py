"""Documents: HTML pages that need no network, with style, script and images inlined; and JUnit's XML.

File names and error messages may contain any character; `printable` sanitises them for both formats.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mi_refract.io.safe_files import write_atomically
from mi_refract.io.text import compact, distinguishable, printable, printable_lines

from .embedded_images import EmbeddedImages

if TYPE_CHECKING:
    from markupsafe import Markup

TEMPLATES = Path(__file__).parent / "templates"


def write_page(path: str | Path, template: str, content: Mapping[str, Any], images: EmbeddedImages) -> None:
    """Write the page of `rendered` to `path`. Errors: OSError."""
    write_atomically(path, rendered(template, content, images))


def rendered(template: str, content: Mapping[str, Any], images: EmbeddedImages) -> bytes:
    """Return a page: one of this package's templates, filled with `content`, which is sanitised and escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    def part(name: str) -> Markup:
        text = (TEMPLATES / name).read_text("utf-8")
        return Markup(f"<style>\n{text}</style>" if name.endswith(".css") else f"<script>\n{text}</script>")

    def sanitised(value: object) -> object:
        return printable_lines(value) if isinstance(value, str) and not isinstance(value, Markup) else value

    options: Any = {"autoescape": True, "undefined": StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=FileSystemLoader(TEMPLATES), finalize=sanitised, **options)
    filters: dict[str, Any] = {"compact": compact, "words": words, "code": code}
    environment.filters |= filters
    text = environment.get_template(template).render(**content, part=part, images=images.embedded)
    return text.encode("utf-8", "replace")


def code(text: str) -> Markup:
    """Return escaped HTML in which words between backticks are `<code>`."""
    from markupsafe import Markup, escape

    return Markup(re.sub("`([^`]*)`", r"<code>\1</code>", str(escape(printable_lines(text)))))


def words(value: object) -> str:
    """Return a value of the context as text: items of mappings and lists separated by commas."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {words(item)}" for key, item in value.items())
    return ", ".join(map(words, value)) if isinstance(value, list | tuple) else str(value)


# JUnit ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """One test case; `outcome` "": it passed.

    `group`: JUnit's class name. `kind`: the type of a failure or an error. `message`: one line. `details`, and
    `metrics` (name, value, bound or None), are further lines; for a case that passed they are its output.
    """

    group: str
    name: str
    outcome: Literal["", "failure", "error", "skipped"] = ""
    message: str = ""
    details: Sequence[str] = ()
    kind: str = ""
    metrics: Sequence[tuple[str, float, float | None]] = ()


def write_junit(path: str | Path, name: str, suites: Mapping[str, Sequence[Case]]) -> None:
    """Write the suites, by name, each with the numbers of its cases by outcome; `name`: name of the whole report.

    Errors: OSError.
    """
    from xml.etree import ElementTree as xml  # imported late: pages do not need it

    root = xml.Element("testsuites", name=printable(name))
    for title, cases in suites.items():
        suite = xml.SubElement(root, "testsuite", {"name": printable(title)} | _counts(cases))
        for case in cases:
            element = xml.SubElement(suite, "testcase", classname=printable(case.group), name=printable(case.name))
            lines = list(case.details)
            for metric, value, bound in case.metrics:
                text, allowed = (compact(value), "") if bound is None else distinguishable(value, bound)
                lines.append(f"{metric} {text}" + (f" (allowed {allowed})" if allowed else ""))
            details = "\n".join(map(printable, lines)) or None
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
    outcomes = Counter(case.outcome for case in cases)
    counts = {"failures": outcomes["failure"], "errors": outcomes["error"], "skipped": outcomes["skipped"]}
    return {key: str(count) for key, count in ({"tests": len(cases)} | counts).items()}
