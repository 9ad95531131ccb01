"""Notebooks of the site: format, names and commands. The site's build executes them."""

import ast
import inspect
import json
import re
import shlex
import subprocess
from pathlib import Path

import pytest
import typer

from mi_refract.cli import app

NOTEBOOKS = sorted((Path(__file__).parents[2] / ".github/docs/tutorials").glob("*.ipynb"))
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def sources(path, magic=""):
    """Return the text of each Python cell, or of each cell that begins with `%%magic`, without that line."""
    cells = [cell for cell in json.loads(path.read_text("utf-8"))["cells"] if cell["cell_type"] == "code"]
    texts = ["".join(cell["source"]) for cell in cells]
    if not magic:
        return [text for text in texts if not text.startswith("%%")]
    return [text.partition("\n")[2] for text in texts if text.startswith(f"%%{magic}")]


@each_notebook
def test_a_notebook_is_valid_without_outputs(path):
    text = path.read_text("utf-8")
    book = json.loads(text)
    assert (book["nbformat"], book["nbformat_minor"], book["metadata"]["kernelspec"]["name"]) == (4, 5, "python3")
    assert text == json.dumps(book, indent=1, ensure_ascii=False) + "\n"
    assert [cell["id"] for cell in book["cells"]] == [f"{path.stem}-{i + 1:02}" for i in range(len(book["cells"]))]
    for cell in book["cells"]:
        required = {"cell_type", "id", "metadata", "source"}
        if cell["cell_type"] == "code":
            required |= {"execution_count", "outputs"}
            assert (cell["execution_count"], cell["outputs"]) == (None, [])
        assert cell.keys() == required and cell["metadata"] == {} and cell["source"]
        assert cell["cell_type"] in ("code", "markdown")
    assert "".join(book["cells"][0]["source"]).startswith("# ")


def resolve(node, names):
    """Return the object of this package that `a` or `a.b.c` names; None for any other expression."""
    value = None
    if isinstance(node, ast.Name):
        value = names.get(node.id)
    elif isinstance(node, ast.Attribute) and (base := resolve(node.value, names)) is not None:
        assert not inspect.ismodule(base) or hasattr(base, node.attr), f"{base.__name__} has no {node.attr}"
        value = getattr(base, node.attr, None)
    module = value.__name__ if inspect.ismodule(value) else getattr(value, "__module__", None)
    return value if str(module).startswith("mi_refract") else None


def check_names(tree):
    """Run the imports of this package, and check that used names and keyword arguments of the package exist."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("mi_refract"):
            exec(compile(ast.Module([node], []), "notebook", "exec"), names)
    for node in ast.walk(tree):
        resolve(node, names)
        if isinstance(node, ast.Call) and (function := resolve(node.func, names)) is not None:
            parameters = inspect.signature(function).parameters
            if any(parameter.kind == parameter.VAR_KEYWORD for parameter in parameters.values()):
                continue
            unknown = {keyword.arg for keyword in node.keywords} - parameters.keys()
            assert not unknown, f"{function.__name__} has no {unknown}"
    return names


@each_notebook
def test_the_names_of_the_package_in_a_notebook_exist(path):
    assert check_names(ast.parse("\n".join(sources(path))))


@pytest.mark.parametrize(
    "code",
    [
        "from mi_refract import nonesuch",
        "from mi_refract import media\nmedia.nonesuch(1.5)",
        "from mi_refract.planar import scene_file\nscene_file.load('lens.toml', nonesuch=2)",
    ],
)
def test_check_names_detects_missing_names(code):
    with pytest.raises((ImportError, AssertionError), match="nonesuch"):
        check_names(ast.parse(code))


@each_notebook
def test_commands_of_a_notebook_parse(path, monkeypatch, capfd):
    monkeypatch.setattr(typer.core.TyperCommand, "invoke", lambda self, context: None)
    for script in sources(path, "bash"):
        assert subprocess.run(["bash", "-n"], input=script, text=True, timeout=60).returncode == 0
        for line in re.findall(r"^(?:.*\s)?(mi-refract .*)$", script, re.MULTILINE):
            words = shlex.split(re.sub(r"2?[>|;&].*", "", line), comments=True)
            assert app.main(words[1:]) == 0, (line, capfd.readouterr().err)


def test_programs_in_notebooks_compile():
    programs = [text for path in NOTEBOOKS for text in sources(path, "writefile")]
    assert programs and all(ast.parse(text) for text in programs)
