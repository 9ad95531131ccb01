"""Code blocks of READMEs and documentation pages, to be run as printed."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / ".github" / "docs"
READMES = [ROOT / "README.md", *sorted(ROOT.glob("mi_refract/*/README.md")), ROOT / "validation" / "README.md"]
PAGES = sorted(path for path in DOCS.rglob("*.md") if "python" not in path.parts)  # the site's build writes those


def python_blocks(path: Path) -> list[str]:
    """Return the code of every ```python block of a Markdown file, in order."""
    return blocks(path, "python")


def blocks(path: Path, language: str) -> list[str]:
    """Return the text of every block of a language, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text("utf-8"), re.MULTILINE | re.DOTALL)
