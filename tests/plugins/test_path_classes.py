"""Each class of paths alone, which part of a render with `caustics` = `lamp` holds it, and all of them at once."""

import itertools

import numpy as np
import pytest
from support import path_classes
from support.glass_scenes import GLASS, equal_means, render
from support.path_classes import CLASSES, FROM_LAMPS, UNSEEN, max_depth


def renders(scene, word, spp=256, count=8, first=0, **parameters):
    method = {"max_depth": max_depth(word), "rr_depth": 100} | parameters
    return np.stack([render(scene, spp, seed, **method) for seed in range(first, first + count)])


@pytest.mark.parametrize("word", CLASSES)
def test_a_scene_is_lit_by_its_class_and_by_no_other(word, llvm_variant):
    """It needs every vertex, and shorter paths find nothing."""
    scene = path_classes.scene(word)
    assert renders(scene, word, count=1, type="path").mean() > 1e-4
    assert renders(scene, word, count=1, type="path", max_depth=max_depth(word) - 1).max() == 0
    for black in range(len(word)):
        assert renders(path_classes.scene(word, black=black), word, count=1, type="path").max() == 0


AGREE = [(word, path_classes.MIRROR) for word in (*CLASSES, "STD")] + [(word, GLASS) for word in ("SD", "SSD", "DS")]


@pytest.mark.parametrize(("word", "delta"), AGREE, ids=lambda x: x if isinstance(x, str) else x["type"])
def test_caustics_from_lamps_have_the_light_of_every_class(word, delta, llvm_variant):
    scene = path_classes.scene(word, delta=delta)
    theirs, ours = renders(scene, word, type="path"), renders(scene, word, caustics="lamp")
    assert theirs.mean() > 0 and equal_means(theirs, ours)


@pytest.mark.parametrize(("word", "lamp"), [*((word, "point") for word in CLASSES), ("SD", "spot"), ("SDD", "spot")])
def test_of_lamps_of_zero_size_they_have_all_but_what_is_seen_by_a_delta_lobe(word, lamp, llvm_variant):
    """`ptracer` has what surfaces show that scatter, `path` what no delta lobe has cast on them."""
    scene = path_classes.scene(word, lamp)
    ours = renders(scene, word, caustics="lamp")
    if word in UNSEEN:
        assert ours.max() == 0
    else:
        theirs = renders(scene, word, type="ptracer" if word in FROM_LAMPS else "path")
        assert theirs.mean() > 0 and equal_means(theirs, ours)


@pytest.mark.parametrize("lamp", ["area", "point"])
def test_the_sum_over_classes_is_the_image_where_all_are_lit_at_once(lamp, llvm_variant):
    """Of three vertices that are half S and half D: an eighth of each class alone, of those that have an estimator."""
    words = ["".join(letters) for letters in itertools.product("SD", repeat=3)]
    theirs = []
    for word in words:
        ends = word[0] + word[-1]
        if lamp == "area" or ends != "SS":
            method = "ptracer" if lamp != "area" and ends == "SD" else "path"
            theirs.append(renders(path_classes.scene(word, lamp), word, type=method) / 8)
            assert theirs[-1].mean() > 0
    ours = renders(path_classes.scene("HHH", lamp), "HHH", caustics="lamp", first=100)
    assert equal_means(sum(theirs), ours)
