"""The study of gradients sees a direction that stays attached after a lobe that is not delta."""

import pytest

from mi_refract import backend
from mi_refract.plugins import path_loop
from validation.renders import gradients
from validation.run.context import PROFILES, Context


@pytest.fixture
def context(tmp_path, llvm_variant):
    return Context(PROFILES["quick"], tmp_path, "llvm_ad_rgb", backend.detect(), backend.usable_variants())


def test_a_direction_that_stays_attached_is_seen(context, monkeypatch):
    """Rough metal fails, glass does not: after its lobes the direction is attached in any case."""
    metal, glass = gradients.QUICK
    (sound,) = gradients.rows(context, metal)
    assert sound.verdict == "pass"
    assert sound.values["detectable"] < 0.05
    monkeypatch.setattr(path_loop, "at_fixed_direction", lambda v, context, si, bsdf, bs, w, d, active: (w, d, bs.pdf))
    (attached,) = gradients.rows(context, metal)
    assert "z" in attached.broken and attached.values["off"] > 0.05
    (through,) = gradients.rows(context, glass)
    assert through.verdict == "pass"
