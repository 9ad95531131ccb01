"""Which image is compared with which: patterns of names, maps of paths, variants, names on the command line."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.diff_images import found, image

from mi_refract.image_diff import folders as diff
from mi_refract.image_diff import name_patterns, pairing, text_reports
from mi_refract.image_diff.settings import ComparisonSpec, Entry, Map, Settings

OSL = Settings(maps=(Map("{dir}/ref/{name}", "{dir}/{name}"),))
VARIANTS = Settings.for_all(accept=("{stem}-*{suffix}",))


@pytest.mark.parametrize(
    ("pattern", "name", "same"),
    [
        ("a[1].exr", "a[1].exr", True),
        ("a[1].exr", "a1.exr", False),
        ("glass/*.exr", "glass/a/b.exr", True),
        ("glass/?.exr", "glass/a.exr", True),
        ("glass/?.exr", "glass/ab.exr", False),
        ("*.exr", "a.exr.png", False),
        ("a.exr", "aaexr", False),
        ("*", "line\nbreak.exr", True),
    ],
)
def test_patterns(pattern, name, same):
    assert name_patterns.matches(pattern, name) == same


@pytest.mark.parametrize(
    ("template", "name", "values"),
    [
        ("{dir}/ref/{name}", "a/b/ref/out.exr", {"dir": "a/b", "name": "out.exr"}),
        ("{dir}/ref/{name}", "ref/out.exr", {"dir": "", "name": "out.exr"}),
        ("{dir}/ref/{name}", "a/out.exr", None),
        ("{dir}/{stem}.png", "a.b.png", {"dir": "", "stem": "a.b"}),
        ("{stem}_ref{suffix}", "a_ref.exr", {"stem": "a", "suffix": ".exr"}),
        ("{stem}/{stem}.exr", "a/b.exr", None),
    ],
)
def test_a_template_and_the_names_it_makes(template, name, values):
    assert name_patterns.parsed(template, name) == values
    if values is not None:
        assert name_patterns.filled(template, values) == name


def test_references_in_a_folder_beside_the_new_images(tmp_path):
    for name in ("a/ref/out.exr", "ref/top.exr", "a/checker.exr", "b/ref/lost.exr"):
        image(tmp_path / "old" / name)
    for name in ("a/out.exr", "top.exr", "c/added.exr"):
        image(tmp_path / "new" / name)
    results = diff.diff(tmp_path / "old", tmp_path / "new", OSL)
    assert found(results) == {
        "a/out.exr": ("equal", "unchanged"),
        "b/lost.exr": ("different", "removed"),
        "c/added.exr": ("different", "added"),
        "top.exr": ("equal", "unchanged"),
    }
    (added,) = [result for result in results.results if result.name == "c/added.exr"]
    assert added.target == tmp_path / "old/c/ref/added.exr"


def test_both_in_one_tree(tmp_path):
    image(tmp_path / "a/ref/out.exr")
    image(tmp_path / "a/out.exr", gain=1.1)
    results = diff.diff(tmp_path, tmp_path, OSL)
    assert found(results) == {"a/out.exr": ("different", "changed")}
    (result,) = results.results
    assert results.reproduce(result) == f"mi-refract diff {tmp_path} {tmp_path} a/out.exr"


def test_two_references_of_one_image_are_an_error(tmp_path):
    for name in ("ref/a.exr", "base/a.exr"):
        image(tmp_path / "old" / name)
    image(tmp_path / "new/a.exr")
    maps = (Map("ref/{name}", "{name}"), Map("base/{name}", "{name}"))
    (result,) = diff.diff(tmp_path / "old", tmp_path / "new", Settings(maps=maps)).results
    assert "a second reference, beside" in result.error


# Variants ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def variants(tmp_path):
    """An image that is equal to the second of two variants of its reference."""
    for name, gain in {"ball.exr": 1, "ball-mac.exr": 1.2, "ball-arm.exr": 1.4, "other.exr": 1}.items():
        image(tmp_path / "old/a" / name, gain=gain)
    image(tmp_path / "new/a/ball.exr", gain=1.4)
    image(tmp_path / "new/a/other.exr")
    return tmp_path / "old", tmp_path / "new"


def test_any_variant_passes_and_is_named(variants):
    results = diff.diff(*variants, VARIANTS)
    assert found(results) == {"a/ball.exr": ("equal", "unchanged"), "a/other.exr": ("equal", "unchanged")}
    (ball,) = [result for result in results.results if result.name == "a/ball.exr"]
    assert ball.matched == variants[0] / "a/ball-arm.exr"
    assert ball.reason.endswith("; matches ball-arm.exr")
    assert text_reports.sentence(results) == "2 images: 2 equal; 2 further references"
    files = diff.diff(variants[0] / "a/ball.exr", variants[1] / "a/ball.exr", VARIANTS)
    assert files.results[0].matched == variants[0] / "a/ball-arm.exr"
    assert found(diff.diff(*variants))["a/ball-arm.exr"] == ("different", "removed")


def test_no_variant_is_equal(variants):
    image(variants[1] / "a/ball.exr", gain=1.3)
    (ball,) = diff.diff(*variants, VARIANTS).results[:1]
    assert (ball.status, ball.matched) == ("different", None)
    assert ball.reason.endswith("; its 2 variants differ, too")


def test_an_image_with_a_new_one_of_its_own_is_no_variant(variants):
    image(variants[1] / "a/ball-arm.exr", gain=1.4)
    assert found(diff.diff(*variants, VARIANTS)) == {
        "a/ball.exr": ("different", "changed"),
        "a/ball-arm.exr": ("equal", "unchanged"),
        "a/other.exr": ("equal", "unchanged"),
    }


def test_a_variant_passes_where_the_first_cannot_be_compared(variants):
    image(variants[0] / "a/ball.exr", shape=(8, 8, 3))
    assert found(diff.diff(*variants, VARIANTS))["a/ball.exr"] == ("equal", "unchanged")
    (variants[0] / "a/ball-arm.exr").write_bytes(b"no image")
    assert found(diff.diff(*variants, VARIANTS))["a/ball.exr"] == ("error", "unknown")


def test_a_pattern_that_matches_the_reference_itself(variants):
    itself = Settings.for_all(accept=("{stem}*",))
    results = diff.diff(*variants, itself)
    assert {result.status for result in results.results} == {"error"}
    assert "matches the reference" in results.results[0].error


# Names ------------------------------------------------------------------------------------------------------------


def test_only_the_named_images(folders):
    assert found(diff.diff(*folders, names=["inner/*"])) == {"inner/changed.exr": ("different", "changed")}
    with pytest.raises(ValueError, match=r"none\.exr: matches no image; expected "):
        diff.diff(*folders, names=["none.exr"])
    assert diff.diff(*folders, Settings((Entry("added.exr", {}),)), names=["same.exr"]).unused == ()


def test_files_beside_a_reference(tmp_path):
    target = tmp_path / "a/ball.exr"
    assert pairing.beside("{stem}_mask.png", target, tmp_path) == tmp_path / "a/ball_mask.png"
    assert pairing.beside("{root}/masks/{dir}/{stem}.png", target, tmp_path) == tmp_path / "masks/a/ball.png"


def test_a_new_image_is_never_its_own_reference(tmp_path):
    image(tmp_path / "ball.exr")
    image(tmp_path / "ball-new.exr", gain=1.5)
    settings = Settings.for_all(accept=("{stem}-*{suffix}",), method="exact")
    assert found(diff.diff(tmp_path / "ball.exr", tmp_path / "ball-new.exr", settings))["ball.exr"][0] == "different"
    mapped = replace(settings, maps=(Map("{stem}.exr", "{stem}-new.exr"),))
    assert found(diff.diff(tmp_path, tmp_path, mapped))["ball-new.exr"] == ("different", "changed")
    rules = (Entry("", {"accept": ("*/{name}",), "method": "exact"}),)
    deep = Settings(rules, maps=(Map("{name}", "out/{name}"),))
    image(tmp_path / "out/ball.exr", gain=1.5)
    by_name = {each.name: each.status for each in diff.diff(tmp_path, tmp_path, deep, names=["out/ball.exr"]).results}
    assert by_name == {"out/ball.exr": "different"}


def test_a_map_that_fits_nothing(folders):
    with pytest.raises(ValueError, match=r"defaults\.map fits no image in .*; expected templates of their paths"):
        diff.diff(*folders, Settings(maps=(Map("nowhere/{name}", "neither/{name}"),)))


def test_variants_in_folders_below_of_two_files(tmp_path):
    image(tmp_path / "old/a.exr", gain=1.5)
    image(tmp_path / "old/mac/a.exr")
    image(tmp_path / "new/a.exr")
    settings = Settings.for_all(accept=("mac/{name}",))
    for sides in (("old", "new"), ("old/a.exr", "new/a.exr")):
        (result,) = diff.diff(*(tmp_path / side for side in sides), settings).results
        assert result.matched == tmp_path / "old/mac/a.exr"


def test_a_variant_by_a_template_that_holds_its_name(tmp_path):
    how = ComparisonSpec(accept=("{stem}-arm64{suffix}", "{stem}-macos{suffix}", "{stem}-*{suffix}"))
    for name in ("macos", "arm64", "icx"):
        assert pairing.variant(tmp_path / "a/ball.exr", how, name) == tmp_path / f"a/ball-{name}.exr"
    with pytest.raises(
        ValueError, match=r"no template in `accept` contains icx or exactly one \*; add .*-icx\{suffix\}"
    ):
        pairing.variant(tmp_path / "ball.exr", ComparisonSpec(accept=("{stem}-macos{suffix}",)), "icx")
