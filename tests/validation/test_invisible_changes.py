"""The study of changes that must not be seen notices a part that is left out."""

from mi_refract.plugins import path_loop
from validation.renders import invisible_changes


def test_a_wrapper_that_is_split_as_if_it_were_glass_is_seen(llvm_variant, monkeypatch):
    monkeypatch.setattr(path_loop, "BOUNDARIES", {*path_loop.BOUNDARIES, "BlendBSDF"})
    found = invisible_changes.rows("llvm_ad_rgb", "glass", 2)
    assert [row.case.split(": ")[1] for row in found if row.broken] == ["blend of itself"]
