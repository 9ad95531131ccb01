"""HTML pages that need no network: a template with style, script and images inlined."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refract.io.atomic import write_atomically
from mi_refract.io.sanitise import printable_lines

from .embedded_images import EmbeddedImages
from .number_text import compact

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

HERE = Path(__file__).parent / "templates"


def write_page(path: str | Path, template: str, content: Mapping[str, Any], images: EmbeddedImages) -> None:
    """Write `template`, one of this package's, filled with `content`, made printable and escaped. Errors: OSError."""
    write_atomically(path, rendered(template, content, images))


def rendered(template: str, content: Mapping[str, Any], images: EmbeddedImages) -> bytes:
    """The page."""
    from markupsafe import Markup

    def part(name: str) -> Markup:
        text = (HERE / name).read_text("utf-8")
        return Markup(f"<style>\n{text}</style>" if name.endswith(".css") else f"<script>\n{text}</script>")

    text = _environment().get_template(template).render(**content, part=part, images=images.embedded)
    return text.encode("utf-8", "replace")


@functools.cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    options: Any = {"autoescape": True, "undefined": StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    options["finalize"] = lambda x: printable_lines(x) if isinstance(x, str) and not isinstance(x, Markup) else x
    environment = Environment(loader=FileSystemLoader(HERE), **options)
    filters: dict[str, Any] = {"compact": compact, "words": words, "code": code}
    environment.filters |= filters
    return environment


def code(text: str) -> Markup:
    """Escaped HTML in which words between backticks are `<code>`."""
    from markupsafe import Markup, escape

    return Markup(re.sub("`([^`]*)`", r"<code>\1</code>", str(escape(printable_lines(text)))))


def words(value: object) -> str:
    """A value of the context as text: mappings and lists separated by commas."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {words(item)}" for key, item in value.items())
    return ", ".join(map(words, value)) if isinstance(value, list | tuple) else str(value)
