"""The commands `mi-refract diff`, `accept` and `self-test`.

They compare images with references, replace references, and show which defects a comparison detects. Modules that only
some calls need are imported inside functions: imports take most of the third of a second of a small comparison.
"""

from __future__ import annotations

import contextlib
import enum
import importlib.util
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from mi_refract.image_diff import folders, pairing, text_reports
from mi_refract.image_diff.methods import AUTO, METHODS
from mi_refract.image_diff.results import Status
from mi_refract.image_diff.settings import FILE, Settings, from_words, key_tables, load, nearest
from mi_refract.io import reference_pack
from mi_refract.io.errors import MISUSE
from mi_refract.io.image_file import MAX_VALUES
from mi_refract.io.safe_files import writable
from mi_refract.io.text import printable

from .app import AllowPlugins, shows
from .interrupts import last_act

RENDERS, SPP = 16, 16  # number of renders of a scene in the self-test, and their samples per pixel
SCENE = ".xml"
Inconclusive = enum.StrEnum("Inconclusive", {"PASS": "pass", "FAIL": "fail"})  # how an inconclusive image counts


Names = Annotated[
    list[str] | None, typer.Argument(metavar="NAME", help="Only these images: paths in the folders (wildcards: * ?).")
]
Method = Annotated[
    str,
    typer.Option(
        help=f"Comparison method: {'|'.join((AUTO, *METHODS))} (--methods). Default: that of the settings, or {AUTO}.",
        show_default=False,
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set a key of [defaults], except map, for all images."),
]
File = Annotated[
    Path | None, typer.Option(metavar="FILE.toml", help=f"Settings of images. Default: {FILE} beside or above them.")
]
MaxValues = Annotated[
    int, typer.Option("--max-values", metavar="N", min=1, help="Largest image to read: width × height × channels.")
]


def _json_schema() -> str:
    from mi_refract.image_diff import results_file

    return results_file.json_schema()


def diff(
    context: typer.Context,
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE", help="An image, or a folder of them.")],
    test: Annotated[
        Path | None,
        typer.Argument(metavar="TEST", help="The image or folder to compare; optional with --check-settings."),
    ] = None,
    names: Names = None,
    method: Method = "",
    options: Set = None,
    settings: File = None,
    max_values: MaxValues = MAX_VALUES,
    renders: Annotated[bool, typer.Option("--renders", help="Each folder holds several renders of one image.")] = False,
    inconclusive: Annotated[
        Inconclusive | None, typer.Option(help="Count an inconclusive image as pass or fail. Default: exit code 3.")
    ] = None,
    report: Annotated[Path | None, typer.Option(metavar="OUT.html", help="Write an HTML page with the images.")] = None,
    report_url: Annotated[
        str, typer.Option(metavar="URL", envvar="MI_REFRACT_REPORT_URL", help="Address of the report, for the summary.")
    ] = "",
    junit: Annotated[Path | None, typer.Option(metavar="OUT.xml", help="Write JUnit XML.")] = None,
    json: Annotated[Path | None, typer.Option(metavar="OUT.json", help="Write JSON.")] = None,
    github: Annotated[
        bool, typer.Option("--github", help="For GitHub Actions: print annotations and write the job's summary.")
    ] = False,
    methods: Annotated[
        bool,
        typer.Option("--methods", is_eager=True, callback=shows(key_tables), help="Print the methods and all keys."),
    ] = False,
    json_schema: Annotated[
        bool,
        typer.Option("--json-schema", is_eager=True, callback=shows(_json_schema), help="Print the schema of --json."),
    ] = False,
    check_settings: Annotated[
        bool, typer.Option("--check-settings", help="Print the method and settings of each image; compare nothing.")
    ] = False,
) -> None:
    """Compare images with their references. Exit code 0: equal, 1: different, 2: not comparable, 3: inconclusive."""
    require_extra("scipy", *["jinja2"] * bool(report))
    if test is None and not check_settings:
        raise ValueError("two paths are needed; expected mi-refract diff REFERENCE TEST")
    resolved = _settings(reference, test or reference, method, options or [], settings, max_values)
    if check_settings or test is None:
        all_pairs = pairing.pairs(reference, test or reference, resolved)
        pairs = pairing.named(all_pairs, names or [])
        unused, checked = list[str](), list(pairs)
        if reference.is_dir():
            checked += pairing.wrong_entries(resolved, all_pairs)
            unused = resolved.unused([pair.name for pair in all_pairs])
            if test is not None:  # REFERENCE compared with itself holds each variant as a new image
                unused += pairing.unused_templates(all_pairs)
        warnings = [f"{pattern}: matches no image" for pattern in unused]
        errors = [f"{pair.name}: {error}" for pair in checked if (error := pairing.error_of(pair, reference))]
        text_reports.print_table(text_reports.settings_table(pairs))
        for line in warnings + errors:
            print(f"mi-refract: {printable(line)}", file=sys.stderr)
        raise typer.Exit(MISUSE if errors else 0)
    for path, suffixes in ((report, (".html", ".htm")), (junit, (".xml",)), (json, (".json",))):
        if path:
            writable(path, suffixes)
    pack, page = reference_pack.of_references(reference, test), None
    if report:
        from mi_refract.image_diff.html_report import Page

        page = Page(report)
    with _progress() as progress:
        results = folders.diff(
            reference,
            test,
            resolved,
            names=names or [],
            renders=renders,
            inconclusive=inconclusive or "",
            view=page.view if page else None,
            digests=bool(json),
            progress=progress,
        )
    try:
        if junit or json:
            from mi_refract.image_diff import results_file

            results_file.write(results, reference_pack.origin(context.obj, pack), junit, json)
        if page:
            from mi_refract.io.image_file import versions

            software = {name: version for name, version in versions().items() if version != "unknown"}
            page.write(results, software, results.command("diff", *(names or [])), str(json or ""))
    finally:  # print the verdict even if a file cannot be written
        text_reports.print_results(results)
    if github:
        from mi_refract.image_diff import results_file

        results_file.write_github(results, str(report or ""), report_url)
    raise typer.Exit(results.exit_code)


def accept(
    reference: Annotated[
        Path | None, typer.Argument(metavar="REFERENCE", help="As for diff; optional with --from, like TEST.")
    ] = None,
    test: Annotated[Path | None, typer.Argument(metavar="TEST", help="As for diff.")] = None,
    names: Names = None,
    method: Method = "",
    options: Set = None,
    settings: File = None,
    max_values: MaxValues = MAX_VALUES,
    source: Annotated[
        Path | None,
        typer.Option("--from", metavar="OUT.json", help="Accept the results of an earlier diff --json OUT.json."),
    ] = None,
    as_variant: Annotated[
        str, typer.Option(metavar="NAME", help="Add the new images as further references, named as key `accept` says.")
    ] = "",
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
) -> None:
    """Copy new images over the references that they differ from, after confirmation. Nothing is deleted."""
    require_extra("scipy")
    from mi_refract.image_diff import accept as accepting

    if source:
        from mi_refract.image_diff import results_file

        if (reference is None) != (test is None):
            raise ValueError(f"{reference}: only one path; with --from, give both folders before the names, or none")
        if options or method:
            raise ValueError("--from repeats an earlier comparison; do not combine it with --method or --set")
        results = results_file.read(source, reference, test)
        results = replace(results, results=tuple(pairing.named(results.results, names or [])))
        resolved = _settings(results.reference, results.test, "", [], settings, max_values)
        results = results_file.with_settings(results, resolved)
        text_reports.print_errors(results)
    elif reference is None or test is None:
        raise ValueError("two paths are needed; expected mi-refract accept REFERENCE TEST, or --from OUT.json")
    else:
        resolved = _settings(reference, test, method, options or [], settings, max_values)
        with _progress() as progress:
            results = folders.diff(reference, test, resolved, names=names or [], to_accept=True, progress=progress)
        text_reports.print_results(results)
    if reference_pack.of_references(results.reference):
        text = f"{results.reference}: in a reference pack, which stays as published"
        raise ValueError(f"{text}; expected your own references")
    try:
        copies = list(accepting.changes(results, as_variant))
    except accepting.UnreadableImage as error:
        if error.result.status is Status.ERROR:  # printed above
            raise typer.Exit(MISUSE) from None
        raise
    for copy in copies:
        print(printable(f"{copy.new} → {copy.reference}{'' if copy.replaced else ' (new)'}"))
    if not copies:
        print("nothing to accept")
        return
    if not yes and not sys.stdin.isatty():
        raise ValueError("accept asks for confirmation on a terminal; without a terminal, pass --yes")
    if not yes and not typer.confirm(f"Accept {len(copies)} as the reference{'' if len(copies) == 1 else 's'}?"):
        print("nothing accepted")
        raise typer.Exit(1)
    acceptance = accepting.Acceptance(copies)
    with last_act(lambda: print(f"mi-refract: interrupted; {printable(acceptance.stop())}", file=sys.stderr)):
        acceptance.run()
    print(f"{len(copies)} accepted")


def require_extra(*packages: str) -> None:
    """Raise ValueError if a package is not installed."""
    if not all(map(importlib.util.find_spec, packages)):
        raise ValueError("comparing needs the extra `diff`: pip install 'mi-refract[diff]'")


def _settings(
    reference: Path, test: Path, method: str, words: Sequence[str], file: Path | None, max_values: int
) -> Settings:
    """Return the settings of the options and of the settings file. ValueError or OSError if either is invalid."""
    # The folder of references may not exist yet.
    are_folders = reference.is_dir() or test.is_dir()
    folder = reference if are_folders else reference.parent
    path = file or nearest(folder)
    flags = ["--method", method] if method else []
    for word in words:
        flags += ["--set", word]
    flags += ["--max-values", str(max_values)] if max_values != MAX_VALUES else []
    flags += ["--settings", str(file)] if file else []
    layer = from_words(method, words)
    settings = load(path, layer, max_values) if path else Settings((layer,), max_values=max_values)
    for_all = replace(settings, rules=tuple(rule for rule in settings.rules if not rule.pattern))
    if error := for_all.of("").error:  # in the layers of all images: one error, not one an image
        raise ValueError(error)
    above = folder.resolve().relative_to(path.parent.resolve()) if path and not file else Path()
    if path and above.parts and settings.maps and are_folders:  # for files, see `pairing.pairs`
        raise ValueError(f"{path}: `map` is for whole folders; expected {path.parent} as REFERENCE, or --settings")
    return replace(settings, flags=tuple(flags), above=above)


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[int, int], None]]:
    """Yield `progress(done, total)`, which counts images: it draws a progress bar on a terminal."""
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("comparing", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


Images = Annotated[
    Path, typer.Argument(metavar="REFERENCE", help="An image, a folder of renders of one image, or a scene.")
]


def self_test(reference: Images, max_values: MaxValues = MAX_VALUES, allow_plugins: AllowPlugins = None) -> None:
    """Inject synthetic defects into REFERENCE and report which methods detect them.

    Exit code 0: all required defects were detected, 1: one was missed, or equal images were reported as different, 2:
    REFERENCE cannot be read.
    """
    require_extra("scipy")
    from mi_refract.image_diff import self_test as self_tests

    if reference.suffix == SCENE:
        from mi_refract.rendering.scene_files import load_scene

        from .doctor import activate

        activate()
        import mitsuba as mi
        import numpy as np

        scene = load_scene(reference, allow_plugins=allow_plugins or ())
        renders = np.stack([np.array(mi.render(scene, spp=SPP, seed=seed)) for seed in range(RENDERS)])
    elif allow_plugins:
        raise ValueError("--allow-plugins applies to scenes only; expected a scene SCENE.xml as REFERENCE")
    else:
        renders = self_tests.read_images(reference, max_values)
    rows = self_tests.examine(renders, str(reference))
    text_reports.print_table(self_tests.table(rows))
    print("\n".join(self_tests.summary(rows)))
    raise typer.Exit(int(any(row.verdict == "fail" for row in rows)))
