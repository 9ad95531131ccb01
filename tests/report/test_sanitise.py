"""Names and messages from other sources are sanitised in every report: no hidden characters, and markup is text."""

import contextlib
import dataclasses
import io
import json
from xml.etree import ElementTree

import pytest
from rich.console import Console
from support import processes
from support.hostile import NAME, shows_more_than_text

from mi_refract.image_diff import html_report, results_file, text_reports
from mi_refract.image_diff.comparison import Comparison, Metric, Verdict
from mi_refract.image_diff.results import Result, Results, Status
from mi_refract.image_diff.settings import ComparisonSpec
from mi_refract.io.reference_pack import origin
from mi_refract.planar import figure, path_tree, scene_file
from mi_refract.ray_sets import check_answers, reports
from mi_refract.ray_sets.diagnosis import Explanation
from mi_refract.report import plots, run_report
from mi_refract.report.row import Row

pytest.importorskip("jinja2")


def printed(table):
    console = Console(width=10_000, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(table, highlight=False)
    return capture.get()


def output_of(write, *arguments, **options):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(out):
        write(*arguments, **options)
    return out.getvalue()


@pytest.fixture
def results(tmp_path):
    how = ComparisonSpec("exact", {}, NAME)
    comparison = Comparison("exact", Verdict.DIFFERENT, NAME, (Metric(NAME, 2.0, 1.0),))
    error = Result(NAME, Status.ERROR, tmp_path, tmp_path, how, error=NAME)
    added = Result(NAME, Status.DIFFERENT, None, tmp_path, how)
    statuses = Status.INCONCLUSIVE, Status.EQUAL
    inconclusive, equal = (Result(NAME, status, tmp_path, tmp_path, how, comparison) for status in statuses)
    all_results = (error, added, inconclusive, equal)
    return Results(tmp_path / "old", tmp_path / NAME.replace("/", ""), all_results, unused=(NAME,))


def findings():
    """Findings of one wrong answer, in a set whose regime has a hostile name."""
    fields = {field.name: 1 for field in dataclasses.fields(check_answers.RegimeErrors)}
    regime = check_answers.RegimeErrors(**fields | {"regime": NAME, "replay": {NAME: NAME}})
    problems = (check_answers.Problem("unknown", 1, NAME),)
    explanations = (Explanation(NAME, NAME, 1.0, 0.1, True),)
    return check_answers.Findings(
        "f32", 2.0**-23, NAME, "zero", True, (regime,), problems, explanations, {"seed": NAME}
    )


FORMS = {
    "terminal": lambda results, path: output_of(text_reports.print_results, results),
    "GitHub": lambda results, path: output_of(results_file.write_github, results).replace("::", ""),
    "Markdown": lambda results, path: text_reports.markdown(results),
    "JUnit": lambda results, path: results_file.write(results, origin([], None), path) or path.read_text(),
    "HTML": lambda results, path: html_report.write(path, results, {NAME: [NAME]}, NAME) or path.read_text(),
    "terminal, rays": lambda results, path: printed(reports.table(findings())),
    "terminal, summary of rays": lambda results, path: printed(reports.summary(findings())),
    "JUnit, rays": lambda results, path: reports.write_junit(path, {NAME: findings()}) or path.read_text(),
    "HTML, rays": lambda results, path: (
        reports.write_html(path, {NAME: findings()}, {NAME: NAME}, NAME) or path.read_text()
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_reports_of_images_and_rays_are_sanitised(form, results, tmp_path):
    text = FORMS[form](results, tmp_path / "out")
    assert "task.x" in text
    assert shows_more_than_text(text) == []
    assert "<script>&" not in text or form.startswith(("terminal", "GitHub"))


def test_json_keeps_hostile_names(results, tmp_path):
    results_file.write(results, origin([], None), data=tmp_path / "out.json")
    assert json.loads((tmp_path / "out.json").read_bytes())["results"][0]["name"] == NAME


def test_reports_of_rows_are_sanitised(tmp_path):
    row = Row(NAME, NAME, NAME, NAME, {NAME: 2.0}, budgets={NAME: 1.0}, reason=NAME, replay={NAME: NAME})
    curve = dataclasses.replace(row, curves={NAME: [(1.0, 1.0), (2.0, 3.0)]}, subject="other")
    absent = Row(NAME, "absent", NAME, NAME, reason=NAME)
    context = {NAME: NAME, "title": NAME, "replay": NAME, "studies": {NAME: {"title": NAME, "text": NAME}}}
    rows = [row, curve, absent]
    run_report.write_html(tmp_path / "out.html", rows, context, tmp_path)
    run_report.write_junit(tmp_path / "out.xml", rows, context)
    ElementTree.parse(tmp_path / "out.xml")
    for text in ((tmp_path / "out.html").read_text(), (tmp_path / "out.xml").read_text()):
        assert shows_more_than_text(text) == [] and "<script>&" not in text
    assert shows_more_than_text(printed(run_report.summary(rows))) == []


def test_plots_are_sanitised():
    name = "::x\x1b[31m\u202e##[error]<b>&"
    curves = plots.curves_svg({name: [(1, 1), (2, 2)]}, plots.Axes(name, name), salt="x")
    panels = {name: plots.Scatter({name: [(1, 1), (2, 2)]}, [], 1.0)}
    scatter = plots.scatter_svg(panels, plots.Axes(name, name), floor=name, front=True, salt="y")
    for svg in (curves, scatter):
        assert svg.count("error]") > 2
        assert shows_more_than_text(svg) == []
        ElementTree.fromstring(svg)


def test_planar_figures_are_sanitised(tmp_path):
    path = tmp_path / "##[error]\u202e.toml"
    title = "title = '::x::<b>&'".replace("'", '"').replace("<b>", r"\u001b[31m\u202e##[error]<b>") + "\n"
    text = title + (processes.ROOT / "scenes/planar/lens.toml").read_text().replace("title", "# title")
    path.write_text(text)
    scene = scene_file.load(path)
    svg = figure.draw(scene, path_tree.follow_scene(scene), ".svg").decode()
    assert "error]" in svg
    assert shows_more_than_text(svg) == []
    ElementTree.fromstring(svg)
