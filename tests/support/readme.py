"""The examples of a README, to be run as they are printed."""

from __future__ import annotations

import re
from pathlib import Path


def python_blocks(path: Path) -> list[str]:
    """The code of every ```python block of a Markdown file, in order."""
    return blocks(path, "python")


def blocks(path: Path, language: str) -> list[str]:
    """The text of every block of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text("utf-8"), re.MULTILINE | re.DOTALL)
