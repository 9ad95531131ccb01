"""One HTML page that needs no other file and no network: a template with style, script and images inlined."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mi_refract.io.atomic import write_atomically
from mi_refract.io.outside_text import printable_lines

from .embedded_images import EmbeddedImages
from .first_page import code
from .number_text import compact

HERE = Path(__file__).parent / "templates"


def write_page(path: str | Path, template: str, content: Mapping[str, Any], images: EmbeddedImages) -> None:
    """Write `template`, one of this package's, filled with `content`, made printable and escaped. Errors: OSError."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    options: Any = {"autoescape": True, "undefined": StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    options["finalize"] = lambda value: value if isinstance(value, Markup) else _text(value)
    environment = Environment(loader=FileSystemLoader(HERE), **options)
    filters: dict[str, Any] = {"compact": compact, "words": words, "code": code}
    environment.filters |= filters
    inline = {name: Markup((HERE / f"report.{name}").read_text("utf-8")) for name in ("css", "js")}
    text = environment.get_template(template).render(**content, **inline, images=images.embedded)
    write_atomically(path, text.encode("utf-8", "replace"))


def _text(value: Any) -> Any:
    return printable_lines(value) if isinstance(value, str) else value


def words(value: Any) -> str:
    """A value of the context as text: mappings and lists separated by commas."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {words(item)}" for key, item in value.items())
    return ", ".join(map(words, value)) if isinstance(value, list | tuple) else str(value)
