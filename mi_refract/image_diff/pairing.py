"""Which image of one folder is compared with which of the other: by their paths, or as the settings map them.

In: two paths and the settings. Out: a result for each pair, which is still to be compared, with the other references
that it may match; and what cannot be read. No image is read here.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from dataclasses import replace
from os.path import realpath  # `Path.resolve` raises RuntimeError for links in a circle
from pathlib import Path

from . import name_patterns
from .results import Result, Status
from .settings import ComparisonSpec, Map, Settings

HIDDEN = ComparisonSpec(skip=True, reason="hidden: a name in its path begins with a dot")
# Endings of images that OpenImageIO, as it is on PyPI, cannot read.
UNREADABLE = {"arw", "astc", "avif", "cr2", "cr3", "dcm", "dng", "flif", "heic", "heif", "hif", "jxr", "ktx", "ktx2"}
UNREADABLE |= {"nef", "pcx", "qoi", "raf", "xcf"}
ROOT = "{root}/"  # before a template of a path that is not beside the reference


def require_apart(reference: Path, test: Path, maps: Sequence[Map] = (), new: bool = False) -> None:
    """ValueError where one path is the other or lies within it, OSError where one does not exist.

    `maps`: where the settings have any, references and new images may share a folder. `new`: the reference need not
    exist yet.
    """
    for role, path in (("test", test), ("reference", reference)):
        if not path.exists() and not (new and role == "reference"):
            raise FileNotFoundError(f"{path}: no such {role} file or folder")
    if maps and test.is_dir():
        return
    if reference.exists() and reference.samefile(test):
        raise ValueError(f"{test}: the same path as the reference {reference}; expected two different paths")
    inner, outer = reference.resolve(), test.resolve()
    if inner.is_relative_to(outer) or outer.is_relative_to(inner):
        raise ValueError(f"{test}: one path contains the other, {reference}; use separate folders")


def pairs(reference: Path, test: Path, settings: Settings) -> list[Result]:
    """The images of both sides by name, each with how it is compared. ValueError where a folder holds no image."""
    known = reference.exists()
    if known and reference.is_dir() != test.is_dir():
        raise ValueError(f"{reference}, {test}: cannot compare a folder with a file")
    if not test.is_dir():
        pair = _pair(reference.name, reference if known else None, test, reference)
        pair = replace(pair, how=settings.of(pair.name))
        if not pair.how.accept:
            return [pair]
        deep = any("/" in template for template in pair.how.accept)
        beside_it = reference.parent.rglob("*") if deep else reference.parent.iterdir()
        others = sorted(path for path in beside_it if path.is_file() and path != reference)
        return [_with_variants(pair, [path for path in others if not path.samefile(test)])]
    (old, lost, concealed), (new, missed, hidden) = images_in(reference) if known else ({}, [], []), images_in(test)
    for folder, nothing in ((reference, known and not old and not lost), (test, not new and not missed)):
        if nothing:
            raise ValueError(f"{folder}: contains no image; expected at least one")
    if settings.maps:
        results = _mapped(old, new, settings.maps)
    else:
        results = [_pair(name, old.get(name), new.get(name), Path(name)) for name in sorted(old | new)]
    results = [replace(pair, how=how_of(settings, pair.name, pair.target)) for pair in results]
    results = [replace(pair, target=reference / pair.target) for pair in results]
    own: set[Path] = set()  # masks and variances that the settings name for a pair: they are no images to compare
    for pair in results:
        sides = [(path, root) for path, root in ((pair.reference, reference), (pair.test, test)) if path]
        files = {mask} if (mask := _mask_of(pair, reference)) else set()
        if pair.how.reads_variance:
            files |= {beside(pair.how.variance, path, root, pair.how.above) for path, root in sides}
        own |= files - {pair.reference, pair.test}
    results = [pair for pair in results if not {pair.reference, pair.test} - {None} <= own]
    # A reference that is a variant, and has no new image, is not one that was removed. In a tree of both no image is
    # its own reference.
    with_new, tests = {pair.target for pair in results if pair.test}, {realpath(x.test) for x in results if x.test}
    others = [path for path in old.values() if path not in own | with_new and realpath(path) not in tests]
    results = [_with_variants(pair, others) for pair in results]
    taken = {path for pair in results for path in pair.variants}
    results = [pair for pair in results if pair.test or pair.target not in taken]
    if not results and not lost and not missed:
        raise ValueError(f"defaults.map fits no image in {reference} and {test}; expected templates of their paths")
    unread = (_pair(name, None, None, reference / name, error) for name, error in lost + missed)
    results += [replace(pair, how=settings.of(pair.name)) for pair in unread]
    skipped = (_pair(name, None, None, reference / name) for name in sorted({*concealed, *hidden}))
    return [*results, *(replace(pair, how=HIDDEN) for pair in skipped)]


def _pair(name: str, reference: Path | None, test: Path | None, target: Path, error: str = "") -> Result:
    return Result(name, Status.DIFFERENT, reference, test, target=target, error=error)


def how_of(settings: Settings, name: str, target: Path) -> ComparisonSpec:
    """How the image is compared with its reference; `name`, `target`: their paths in the folders.

    The fields of its `accept` are those of the map that pairs the two: those of the map's {name}, if it has one.
    """
    for rule in settings.maps:
        values = name_patterns.parsed(rule.reference, target.as_posix())
        if values is not None and name_patterns.filled(rule.test, values) == name:
            own = name_patterns.fields(values["name"]) if "name" in values else {}
            return replace(settings.of(name), fields=own | values)
    return settings.of(name)


def unused_templates(pairs: Sequence[Result]) -> list[str]:
    """The templates of `accept` that match no file; as of `Settings.unused`."""
    templates = dict.fromkeys(each for pair in pairs if not pair.how.above.parts for each in pair.how.accept)
    for pair in pairs:
        for template in pair.how.accept:
            if pair.error or _matched(pair, template, pair.variants):
                templates.pop(template, None)
    return [f"accept = {template!r}" for template in templates]


def named(items: Sequence[Result], patterns: Sequence[str]) -> list[Result]:
    """The results whose names match one of the patterns; all without patterns.

    A pattern that is the name of an image, such as "a*.exr", is that image alone, unless a backslash says how it is to
    be read. ValueError for one that matches none.
    """
    names = {item.name for item in items}
    chosen: set[str] = set()
    for pattern in patterns:
        alone = pattern in names and "\\" not in pattern
        matched = {pattern} if alone else {name for name in names if name_patterns.matches(pattern, name)}
        if not matched:
            raise ValueError(
                f"{pattern}: matches no image; expected the path of an image in its folder (wildcards: * and ?)"
            )
        chosen |= matched
    return [item for item in items if not patterns or item.name in chosen]


def wrong_entries(settings: Settings, pairs: Sequence[Result]) -> list[Result]:
    """A result without sides for each entry that is wrong and matches no image: where it does, that image says so."""
    used = {pair.how.error for pair in pairs}
    wrong = [rule for rule in settings.rules if rule.error and rule.error not in used]
    return [_pair(f"the settings, {rule.where}", None, None, Path(), rule.error) for rule in wrong]


def error_of(pair: Result, reference: Path) -> str:
    """Why the pair cannot be compared, as far as that is known before it is; "" for nothing."""
    mask = _mask_of(pair, reference if reference.is_dir() else reference.parent)
    missing = f"{mask}: no such file; expected a mask" if mask and pair.reference and not mask.exists() else ""
    return pair.error or pair.how.error or missing


def _mapped(old: dict[str, Path], new: dict[str, Path], maps: Sequence[Map]) -> list[Result]:
    """Pairs by the first map that fits. What no map calls a reference is none; a reference is no new image."""
    pairs: dict[str, Result] = {}
    for rule, (path, file) in itertools.product(maps, old.items()):
        if (values := name_patterns.parsed(rule.reference, path)) is None:
            continue
        name = name_patterns.filled(rule.test, values)
        before = pairs.setdefault(name, _pair(name, file, new.get(name), Path(path)))
        if before.reference != file:
            error = f"{file}: a second reference, beside {before.reference}; expected one for {name}"
            pairs[name] = replace(before, error=error)
    references = {realpath(pair.reference) for pair in pairs.values() if pair.reference}
    for name, file in new.items():
        if name not in pairs and realpath(file) not in references:
            fitting = ((rule, name_patterns.parsed(rule.test, name)) for rule in maps)
            targets = (name_patterns.filled(rule.reference, values) for rule, values in fitting if values is not None)
            if target := next(targets, None):
                pairs[name] = _pair(name, None, file, Path(target))
    return [pairs[name] for name in sorted(pairs)]


# Files beside a reference -------------------------------------------------------------------------------------------


def _mask_of(pair: Result, root: Path) -> Path | None:
    """The mask that the settings name for a pair; `root`: the folder of the references."""
    return beside(pair.how.mask, pair.target, root, pair.how.above) if pair.how.mask else None


def _with_variants(pair: Result, others: Sequence[Path]) -> Result:
    """The pair with those of the other references that its settings accept as well."""
    variants: dict[Path, None] = {}
    others = [path for path in others if path.is_relative_to(pair.target.parent)]
    for template in pair.how.accept:
        if _matched(pair, template, [pair.target]):
            error = f"accept = {template!r} matches the reference {pair.target} itself; expected names of others"
            return replace(pair, error=error)
        variants |= dict.fromkeys(_matched(pair, template, others))
    return replace(pair, variants=tuple(variants))


def _matched(pair: Result, template: str, paths: Sequence[Path]) -> list[Path]:
    """The paths that a template of `accept` means for the reference of a pair, by their names."""
    names = {path.relative_to(pair.target.parent).as_posix(): path for path in paths}
    values = {**name_patterns.fields(pair.target.name), **pair.how.fields}
    return [names[name] for name in name_patterns.expanded(template, values, sorted(names))]


def variant(target: Path, how: ComparisonSpec, name: str) -> Path:
    """Where a variant of the reference `target` lies: by the first template of `accept` with the name or one `*`.

    ValueError where there is none, or for a name that would not match it.
    """
    if not name.strip() or name.startswith(".") or set(name) & set("/\\*?\0"):
        raise ValueError(f"--as-variant {name!r}; expected part of a file name, such as macos")
    with_name = [template for template in how.accept if not set(template) & set("*?") and name in template]
    with_star = [template for template in how.accept if template.count("*") == 1 and "?" not in template]
    for template in with_name + with_star:
        fields = {**name_patterns.fields(target.name), **how.fields, "*": name}
        return target.parent / name_patterns.filled(template.replace("*", "{*}"), fields)
    raise ValueError(
        f"{target}: no template in `accept` contains {name} or exactly one *; add to [defaults] in mi-refract.toml: "
        f'accept = ["{{stem}}-{name}{{suffix}}"]'
    )


def is_inside(path: Path, folder: Path) -> bool:
    """Whether the path stays in the folder: no `..` and no link to another folder leads out of it."""
    return path.parent.resolve().is_relative_to(folder.resolve())


def beside(template: str, target: Path, root: Path, above: Path = Path()) -> Path:
    """The file that a template means for a reference: beside it, or after "{root}/" below the folder of the settings.

    `root`: the folder that is compared, `above`: its path in that of the settings.
    """
    top = root.joinpath(*[".."] * len(above.parts))
    base, rest = (top, template[len(ROOT) :]) if template.startswith(ROOT) else (target.parent, template)
    return base / name_patterns.filled(rest, name_patterns.fields((above / target.relative_to(root)).as_posix()))


# Folders ------------------------------------------------------------------------------------------------------------


def images_in(folder: Path) -> tuple[dict[str, Path], list[tuple[str, str]], list[str]]:
    """The files with an image's ending, by their path inside; (name, error) of what cannot be read; hidden images.

    What cannot be read: folders without permission, links to folders, which are not followed, and images of formats
    that OpenImageIO does not read. What is in them would not be compared. A path is hidden if a name in it begins with
    a dot.
    """
    import OpenImageIO as oiio

    formats = (each.split(":") for each in oiio.get_string_attribute("extension_list").split(";") if each)
    readable = (endings for name, endings in formats if name not in ("null", "term", "zfile"))
    endings = {ending for listed in readable for ending in listed.split(",")}  # lower case
    images: dict[str, Path] = {}
    failed: list[tuple[str, str]] = []
    hidden: list[str] = []

    def note(path: Path, error: str) -> None:
        name = path.relative_to(folder).as_posix()
        if "/." not in f"/{name}":
            failed.append((name, error))

    for parent, folders, names in os.walk(folder, onerror=lambda error: note(Path(error.filename), str(error))):
        for path in (Path(parent, name) for name in sorted(folders)):
            if path.is_symlink():
                note(path, f"{path}: a link to a folder; expected a folder")
        for path in (Path(parent, name) for name in names):
            name, ending = path.relative_to(folder).as_posix(), path.suffix[1:].lower()
            if ending in UNREADABLE:
                note(path, f"{path}: OpenImageIO does not read {ending.upper()}; expected a format that it reads")
            elif ending in endings and "/." in f"/{name}":
                hidden.append(name)
            elif ending in endings:
                images[name] = path
    return images, failed, hidden
