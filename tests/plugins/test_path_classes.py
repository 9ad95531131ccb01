"""Renders with `caustics` = `lamp` of each class of paths alone, and of all classes together."""

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
def test_a_scene_is_lit_only_by_its_class_of_paths(word, llvm_variant):
    """The image is black if a vertex is black, and for shorter paths."""
    scene = path_classes.scene(word)
    assert renders(scene, word, count=1, type="path").mean() > 1e-4
    assert renders(scene, word, count=1, type="path", max_depth=max_depth(word) - 1).max() == 0
    for black in range(len(word)):
        assert renders(path_classes.scene(word, black=black), word, count=1, type="path").max() == 0


AGREE = [(word, path_classes.MIRROR) for word in (*CLASSES, "STD")] + [(word, GLASS) for word in ("SD", "SSD", "DS")]


@pytest.mark.parametrize(("word", "delta"), AGREE, ids=lambda x: x if isinstance(x, str) else x["type"])
def test_renders_with_caustics_from_lamps_have_the_light_of_every_class(word, delta, llvm_variant):
    scene = path_classes.scene(word, delta=delta)
    theirs, ours = renders(scene, word, type="path"), renders(scene, word, caustics="lamp")
    assert theirs.mean() > 0 and equal_means(theirs, ours)


@pytest.mark.parametrize(("word", "lamp"), [*((word, "point") for word in CLASSES), ("SD", "spot"), ("SDD", "spot")])
def test_lamps_of_zero_size_light_all_classes_but_those_seen_through_a_delta_lobe(word, lamp, llvm_variant):
    """The reference is `ptracer` for light seen on surfaces that scatter, else `path`."""
    scene = path_classes.scene(word, lamp)
    ours = renders(scene, word, caustics="lamp")
    if word in UNSEEN:
        assert ours.max() == 0
    else:
        theirs = renders(scene, word, type="ptracer" if word in FROM_LAMPS else "path")
        assert theirs.mean() > 0 and equal_means(theirs, ours)


@pytest.mark.parametrize("lamp", ["area", "point"])
def test_a_scene_with_all_classes_is_the_sum_of_its_classes(lamp, llvm_variant):
    """Three vertices are half S and half D: the image is the sum of an eighth of each class that has an estimator."""
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
