"""The documentation site. `.ci/docs` builds it; CONTRIBUTING says how its pages are divided."""

import functools
import os
import re
import sys
from pathlib import Path

import mitsuba
from nbclient import NotebookClient
from sphinx.application import Sphinx

import mi_refract

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
mitsuba.set_variant("scalar_rgb")  # what the reference asks of Mitsuba needs no LLVM

from generated import WRITERS, pages  # noqa: E402

project = "mi_refract"
author = "mi_refract developers"
copyright = author
version = release = mi_refract.__version__

extensions = ["myst_nb", "sphinx_design", "sphinx_copybutton"]
nitpicky = True
# Annotations name types of Dr.Jit, numpy and Mitsuba by short names, which no index here resolves.
nitpick_ignore_regex = [("py:.*", r"(?!mi_refract\.).*")]
suppress_warnings = ["ref.python"]  # of two classes of one short name
python_maximum_signature_line_length = 100
toc_object_entries = False
highlight_language = "text"
smartquotes = False

myst_enable_extensions = ["attrs_inline", "colon_fence"]
myst_heading_anchors = 4
myst_links_external_new_tab = False
nb_execution_mode = "force"
if os.environ.get("MI_REFRACT_DOCS_EXECUTE") == "off":
    nb_execution_mode = "off"
    suppress_warnings += ["misc.highlighting_failure"]  # no kernel says that `%%bash` is no Python
nb_execution_raise_on_error = True
nb_execution_show_tb = True
# `%%bash` hands over a hundred bytes at a time, which may end within an escape sequence.
NotebookClient.__init__ = functools.partialmethod(NotebookClient.__init__, coalesce_streams=True)
nb_execution_in_temp = True  # as for a reader who has the notebook alone
nb_execution_timeout = 600  # of a cell, on a machine that does other work

html_theme = "furo"
html_title = "mi_refract"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_copyright = False
copybutton_exclude = ".linenos, .gp, .go"


def with_generated(app: Sphinx, name: str, source: list[str]) -> None:
    """Put what a function of `generated.WRITERS` makes of the program in place of ```{generated} NAME ARGUMENT```."""
    call = r"^```\{generated\} (\S+)(.*)\n```$"
    source[0] = re.sub(call, lambda found: WRITERS[found[1]](*found[2].split()), source[0], flags=re.MULTILINE)


def setup(app: Sphinx) -> dict[str, bool]:
    """Pages that are nothing but generated, one a room, are written before Sphinx looks for pages."""
    app.connect("source-read", with_generated)
    for name, text in pages().items():
        page = HERE / name
        page.parent.mkdir(exist_ok=True)
        if not page.is_file() or page.read_text("utf-8") != text:
            page.write_text(text, "utf-8")
    return {"parallel_read_safe": True, "parallel_write_safe": True}
