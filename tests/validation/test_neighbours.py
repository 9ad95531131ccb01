"""The study of neighbours sees a BSDF that is split as if it were glass."""

from mi_refract.plugins import path_loop
from validation.renders import neighbours


def test_a_wrapper_that_refuses_a_lobe_and_is_split_all_the_same_is_seen(llvm_variant, monkeypatch):
    monkeypatch.setattr(path_loop, "BOUNDARIES", {*path_loop.BOUNDARIES, "NormalMap"})
    found = neighbours.rows("llvm_ad_rgb", "normalmap", ("refract", "diffuse", "measured"), ((1, 4),))
    assert {row.case for row in found if row.broken} == {"normalmap: refract", "normalmap: split 1, 4 spp"}
    assert [row.reason for row in found if not row.values] == ['Mitsuba: Property "filename" cannot be found!']
