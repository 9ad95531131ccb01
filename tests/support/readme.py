"""The examples of READMEs and of the documentation's pages, to be run as they are printed."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / ".github" / "docs"
READMES = [ROOT / "README.md", *sorted(ROOT.glob("mi_refract/*/README.md")), ROOT / "validation" / "README.md"]
PAGES = sorted(path for path in DOCS.rglob("*.md") if "python" not in path.parts)  # those are written by a build


def python_blocks(path: Path) -> list[str]:
    """The code of every ```python block of a Markdown file, in order."""
    return blocks(path, "python")


def blocks(path: Path, language: str) -> list[str]:
    """The text of every block of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text("utf-8"), re.MULTILINE | re.DOTALL)
