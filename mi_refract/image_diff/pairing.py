"""Pairs of references and new images, by their paths or by the maps of the settings.

Input: two paths and the settings. Output: a `Result` for each pair, not yet compared, with its variants, which are
further references that the new image may match, and a `Result` for each path that cannot be read. No image is read.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from os.path import realpath  # `Path.resolve` raises RuntimeError for links in a circle
from pathlib import Path

from . import name_patterns
from .results import Result, Status
from .settings import ComparisonSpec, Map, Settings

HIDDEN = ComparisonSpec(skip=True, reason="hidden: a name in its path begins with a dot")
# Suffixes of image formats that OpenImageIO from PyPI cannot read.
UNREADABLE = {"arw", "astc", "avif", "cr2", "cr3", "dcm", "dng", "flif", "heic", "heif", "hif", "jxr", "ktx", "ktx2"}
UNREADABLE |= {"nef", "pcx", "qoi", "raf", "xcf"}
ROOT = "{root}/"  # prefix of a template whose path is relative to the folder of the settings


def require_apart(reference: Path, test: Path, maps: Sequence[Map] = (), new: bool = False) -> None:
    """Raise ValueError if one path is or contains the other, OSError if one does not exist.

    `maps`: of the settings; with any, references and new images may share a folder. `new`: the reference may be
    missing.
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
    """Return the pairs of both sides, each with its `ComparisonSpec`.

    ValueError if a folder contains no image, and for files if the settings have a map.
    """
    has_reference = reference.exists()
    if has_reference and reference.is_dir() != test.is_dir():
        raise ValueError(f"{reference}, {test}: cannot compare a folder with a file")
    if not test.is_dir():
        if settings.maps:
            raise ValueError(f"{test}: `map` is for whole folders; expected folders, and the image as NAME")
        pair = _pair(reference.name, reference if has_reference else None, test, reference)
        pair = replace(pair, how=settings.of(pair.name))
        if not pair.how.accept:
            return [pair]
        deep = any("/" in template for template in pair.how.accept)
        folder = reference.parent
        entries = (folder.rglob("*") if deep else folder.iterdir()) if folder.exists() else ()
        others = [path for path in sorted(entries) if path.is_file() and path != reference and not path.samefile(test)]
        if folder.resolve() != test.parent.resolve():  # a file that has a new image of its own is no variant
            own = ((path, test.parent / path.relative_to(folder)) for path in others)
            others = [path for path, new in own if new == test or not new.exists()]
        pair = _with_variants(pair, others)
        return [_without(pair, _files_beside(pair, (reference.parent, test.parent)))]
    old, old_errors, old_hidden = images_in(reference) if has_reference else ({}, [], [])
    new, new_errors, new_hidden = images_in(test)
    for folder, content in ((reference, old or old_errors or not has_reference), (test, new or new_errors)):
        if not content:
            raise ValueError(f"{folder}: contains no image; expected at least one")
    if settings.maps:
        pairs = _mapped(old, new, settings.maps)
    else:
        pairs = [_pair(name, old.get(name), new.get(name), Path(name)) for name in sorted(old | new)]
    pairs = [replace(pair, how=how_of(settings, pair.name, pair.target)) for pair in pairs]
    pairs = [replace(pair, target=reference / pair.target) for pair in pairs]
    # A variant without a new image of its own is not a removed reference. Where references and new images share a
    # folder, a new image is no variant.
    with_new, tests = {pair.target for pair in pairs if pair.test}, {realpath(x.test) for x in pairs if x.test}
    others = [path for path in old.values() if path not in with_new and realpath(path) not in tests]
    pairs = [_with_variants(pair, others) for pair in pairs]
    others_files = set[Path]().union(*(_files_beside(pair, (reference, test)) for pair in pairs))
    pairs = [_without(pair, others_files) for pair in pairs if not {pair.reference, pair.test} - {None} <= others_files]
    variants = {path for pair in pairs for path in pair.variants}
    pairs = [pair for pair in pairs if pair.test or pair.target not in variants]
    if not pairs and not old_errors and not new_errors:
        raise ValueError(f"defaults.map fits no image in {reference} and {test}; expected templates of their paths")
    unreadable = (_pair(name, None, None, reference / name, error) for name, error in old_errors + new_errors)
    pairs += [replace(pair, how=settings.of(pair.name)) for pair in unreadable]
    hidden = (_pair(name, None, None, reference / name) for name in sorted({*old_hidden, *new_hidden}))
    return [*pairs, *(replace(pair, how=HIDDEN) for pair in hidden)]


def _pair(name: str, reference: Path | None, test: Path | None, target: Path, error: str = "") -> Result:
    return Result(name, Status.DIFFERENT, reference, test, target=target, error=error)


def how_of(settings: Settings, name: str, target: Path) -> ComparisonSpec:
    """Return the `ComparisonSpec` of an image and its reference; `name`, `target`: their paths in the folders.

    The fields of its `accept` are those of the map that pairs the two, and the parts of the map's {name} if it has one.
    """
    for rule in settings.maps:
        values = name_patterns.parsed(rule.reference, target.as_posix())
        if values is not None and name_patterns.filled(rule.test, values) == name:
            of_name = name_patterns.fields(values["name"]) if "name" in values else {}
            return replace(settings.of(name), fields=of_name | values)
    return settings.of(name)


def unused_templates(pairs: Sequence[Result]) -> list[str]:
    """Return the templates of `accept` that match no file, as `accept = …`; none of the settings of a parent folder."""
    in_folder = [pair for pair in pairs if not pair.how.above.parts]
    templates = dict.fromkeys(template for pair in in_folder for template in pair.how.accept)
    for pair in pairs:
        for template in pair.how.accept:
            if pair.error or _matched(pair, template, pair.variants):
                templates.pop(template, None)
    return [f"accept = {template!r}" for template in templates]


def named(items: Sequence[Result], patterns: Sequence[str]) -> list[Result]:
    """Return the results whose names match one of the patterns, or all if there are no patterns.

    A pattern without a backslash that is the name of an image, such as "a*.exr", matches that image only. ValueError
    for a pattern that matches no image.
    """
    names = {item.name for item in items}
    chosen: set[str] = set()
    for pattern in patterns:
        is_name = pattern in names and "\\" not in pattern
        matched = {pattern} if is_name else {name for name in names if name_patterns.matches(pattern, name)}
        if not matched:
            expected = "expected the path of an image in its folder (wildcards: * and ?)"
            raise ValueError(f"{pattern}: matches no image; {expected}")
        chosen |= matched
    return [item for item in items if not patterns or item.name in chosen]


def wrong_entries(settings: Settings, pairs: Sequence[Result]) -> list[Result]:
    """Return a result without sides for each invalid entry of the settings that no image of a folder reports.

    None if the settings are those of a parent folder: their entries may be of other images.
    """
    reported = {pair.how.error for pair in pairs}
    rules = settings.rules if settings.above == Path() else ()
    wrong = [rule for rule in rules if rule.error and rule.error not in reported]
    return [_pair(f"the settings, {rule.where}", None, None, Path(), rule.error) for rule in wrong]


def error_of(pair: Result, reference: Path) -> str:
    """Return why the pair cannot be compared, as far as that is known without reading images; "" if it can be."""
    mask = _mask_of(pair, reference if reference.is_dir() else reference.parent)
    is_missing = mask and pair.reference and pair.test and not mask.exists()
    return pair.error or pair.how.error or (f"{mask}: no such file; expected a mask" if is_missing else "")


def _mapped(old: dict[str, Path], new: dict[str, Path], maps: Sequence[Map]) -> list[Result]:
    """Return the pairs, each by the first map that matches.

    A file of `old` that no map matches is not a reference, and a reference is not a new image.
    """
    pairs: dict[str, Result] = {}
    for rule, (path, file) in itertools.product(maps, old.items()):
        if (values := name_patterns.parsed(rule.reference, path)) is None:
            continue
        name = name_patterns.filled(rule.test, values)
        first = pairs.setdefault(name, _pair(name, file, new.get(name), Path(path)))
        if first.reference != file:
            error = f"{file}: a second reference, beside {first.reference}; expected one for {name}"
            pairs[name] = replace(first, error=error)
    references = {realpath(pair.reference) for pair in pairs.values() if pair.reference}
    for name, file in new.items():
        if name not in pairs and realpath(file) not in references:
            for rule in maps:
                if (values := name_patterns.parsed(rule.test, name)) is not None:
                    target = name_patterns.filled(rule.reference, values)
                    pairs[name] = _pair(name, None, file, Path(target))
                    break
    return [pairs[name] for name in sorted(pairs)]


# Files beside a reference -------------------------------------------------------------------------------------------


def _mask_of(pair: Result, root: Path) -> Path | None:
    """Return the path of the mask of a pair, or None; `root`: the folder of the references."""
    return beside(pair.how.mask, pair.target, root, pair.how.above) if pair.how.mask else None


def files_beside(pair: Result, references: Path, images: Iterable[tuple[Path, Path]]) -> set[Path]:
    """Return the mask of a pair and the variances of images: files that are not compared.

    `references`: the folder of the references; `images`: paths, each with the folder of its side.
    """
    mask = _mask_of(pair, references)
    files = {mask} if mask else set()
    if pair.how.variance:
        variances = ((path, beside(pair.how.variance, path, root, pair.how.above)) for path, root in images)
        files |= {variance for path, variance in variances if variance != path}
    return files


def _files_beside(pair: Result, roots: tuple[Path, Path]) -> set[Path]:
    """Return the mask and the variances of a pair and of its variants."""
    images = [(path, roots[0]) for path in (pair.target, *pair.variants)]
    images += [(pair.test, roots[1])] if pair.test else []
    return files_beside(pair, roots[0], images) - {pair.reference, pair.test}


def _without(pair: Result, files: Collection[Path]) -> Result:
    """Return the pair without the variants that are such files."""
    return replace(pair, variants=tuple(path for path in pair.variants if path not in files))


def _with_variants(pair: Result, others: Sequence[Path]) -> Result:
    """Return the pair with its variants: those of the `others` that match its templates of `accept`."""
    variants: dict[Path, None] = {}
    others = [path for path in others if path.is_relative_to(pair.target.parent)]
    for template in pair.how.accept:
        if _matched(pair, template, [pair.target]):
            error = f"accept = {template!r} matches the reference {pair.target} itself; expected names of others"
            return replace(pair, error=error)
        variants |= dict.fromkeys(_matched(pair, template, others))
    return replace(pair, variants=tuple(variants))


def _matched(pair: Result, template: str, paths: Sequence[Path]) -> list[Path]:
    """Return the paths that match a template of `accept` of the pair, sorted by name."""
    names = {path.relative_to(pair.target.parent).as_posix(): path for path in paths}
    values = {**name_patterns.fields(pair.target.name), **pair.how.fields}
    return [names[name] for name in name_patterns.expanded(template, values, sorted(names))]


def variant(target: Path, how: ComparisonSpec, name: str) -> Path:
    """Return the path of a variant of the reference `target`.

    It is given by the first template of `accept` that contains the name, or else exactly one `*`. ValueError if there
    is no such template, or if the name cannot be part of a file name.
    """
    if not name.strip() or name.startswith(".") or set(name) & set("/\\*?\0"):
        raise ValueError(f"--as-variant {name!r}; expected part of a file name, such as macos")
    no_fields = dict.fromkeys(name_patterns.FIELDS, "/")  # no name contains a slash
    fixed = [template for template in how.accept if not set(template) & set("*?")]
    with_name = [template for template in fixed if name in name_patterns.filled(template, no_fields)]
    with_star = [template for template in how.accept if template.count("*") == 1 and "?" not in template]
    for template in with_name + with_star:
        fields = {**name_patterns.fields(target.name), **how.fields, "*": name}
        return target.parent / name_patterns.filled(template.replace("*", "{*}"), fields)
    advice = f'add to [defaults] in mi-refract.toml: accept = ["{{stem}}-{name}{{suffix}}"]'
    raise ValueError(f"{target}: no template in `accept` contains {name} or exactly one *; {advice}")


def is_inside(path: Path, folder: Path) -> bool:
    """Return whether the path is in the folder, after `..` and links to folders are resolved."""
    return path.parent.resolve().is_relative_to(folder.resolve())


def beside(template: str, target: Path, root: Path, above: Path = Path()) -> Path:
    """Return the path for a template: beside the image `target`, or after "{root}/" in the folder of the settings.

    `root`: the compared folder, or the `target` if that is a folder of renders; `above`: its path relative to the
    folder of the settings.
    """
    inside = above / target.relative_to(root)
    values = name_patterns.fields(inside.as_posix() if inside.parts else root.resolve().name)
    path = Path(name_patterns.filled(template.removeprefix(ROOT), values))
    if not template.startswith(ROOT):
        return (target.parent if target.name else target.resolve().parent) / path
    if path.is_relative_to(above):  # without "..", so that it equals the path that a search of the folder finds
        return root / path.relative_to(above)
    return root.joinpath(*[".."] * len(above.parts), path)


# Folders ------------------------------------------------------------------------------------------------------------


def images_in(folder: Path) -> tuple[dict[str, Path], list[tuple[str, str]], list[str]]:
    """Return the images of a folder by relative path, a list of (path, error), and the paths of hidden images.

    Errors: folders without permission, links to folders, which are not followed, and images of formats that OpenImageIO
    does not read. A path is hidden if a name in it begins with a dot.
    """
    import OpenImageIO as oiio

    suffixes: set[str] = set()  # lower case, without the dot
    for entry in filter(None, oiio.get_string_attribute("extension_list").split(";")):  # "openexr:exr,sxr,mxr"
        format_name, extensions = entry.split(":")
        if format_name not in ("null", "term", "zfile"):
            suffixes.update(extensions.split(","))
    images: dict[str, Path] = {}
    failed: list[tuple[str, str]] = []
    hidden: list[str] = []

    def add_error(path: Path, error: str) -> None:
        name = path.relative_to(folder).as_posix()
        if name == "." or "/." not in f"/{name}":  # "." is the folder itself
            failed.append((name, error))

    for parent, folders, names in os.walk(folder, onerror=lambda error: add_error(Path(error.filename), str(error))):
        for path in (Path(parent, name) for name in sorted(folders)):
            if path.is_symlink():
                add_error(path, f"{path}: a link to a folder; expected a folder")
        for path in (Path(parent, name) for name in names):
            name, suffix = path.relative_to(folder).as_posix(), path.suffix[1:].lower()
            if suffix in UNREADABLE:
                add_error(path, f"{path}: OpenImageIO does not read {suffix.upper()}; expected a format that it reads")
            elif suffix in suffixes and "/." in f"/{name}":
                hidden.append(name)
            elif suffix in suffixes:
                images[name] = path
    return images, failed, hidden
