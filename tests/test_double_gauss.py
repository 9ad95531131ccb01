"""A double Gauss, traced exactly by CODE V, retraced surface by surface with every formula in float64."""

import json
import math
from pathlib import Path

import drjit as dr
import pytest

from mi_refract import FORMULAS

Vector = dr.scalar.Array3f64
DATA = Path(__file__).parent / "data" / "double_gauss_codev.json"
FIELDS = {0.0: 0.0, 0.176327: math.tan(math.radians(10)), 0.249328: math.tan(math.radians(14))}
# What printing rounds to: see "digits" in the file.
TANGENT, POSITION = 5e-7, 2.3e-6


def load():
    return json.loads(DATA.read_text())


def hit(p, d, curvature):
    """The intersection with the surface c (x² + y² + z²) = 2 z, next to its vertex, and the surface's normal."""
    p = p - d * (p.z / d.z)  # on the vertex plane, where the smaller root is the near one
    e = curvature * (p.x * p.x + p.y * p.y)
    f = d.z - curvature * (d.x * p.x + d.y * p.y)
    p = p + d * (e / (f + math.copysign(math.sqrt(f * f - curvature * e), f)))
    return p, Vector(-curvature * p.x, -curvature * p.y, 1 - curvature * p.z)


def retrace(formula, ray, prescription):
    """The largest deviation in tangents and in positions over all surfaces."""
    first = ray["surfaces"][0]
    d = dr.normalize(Vector(0, FIELDS[ray["object"][4]], 1))
    p, index = Vector(first[0], first[1], first[2]), 1.0
    tangents = positions = 0.0
    for (curvature, thickness, next_index), printed in zip(prescription, ray["surfaces"], strict=True):
        p, normal = hit(p, d, curvature)
        d, transmitted = formula(d, dr.normalize(normal), index / next_index)
        assert transmitted
        positions = max(positions, *(abs(x - y) for x, y in zip(p, printed, strict=False)))
        tangents = max(tangents, abs(d.x / d.z - printed[3]), abs(d.y / d.z - printed[4]))
        p, index = p - Vector(0, 0, thickness), next_index
    return tangents, positions


@pytest.mark.parametrize("name", FORMULAS)
def test_every_formula_retraces_the_lens_within_the_print(name):
    data = load()
    assert len(data["rays"]) == 9
    for ray in data["rays"]:
        tangents, positions = retrace(FORMULAS[name], ray, data["prescription"])
        assert tangents <= TANGENT
        assert positions <= POSITION


def test_an_index_off_in_the_fifth_digit_is_seen():
    data = load()
    wrong = [[c, t, n * (1 + 1e-5) if n > 1 else n] for c, t, n in data["prescription"]]
    tangents, positions = retrace(FORMULAS["promoted"], data["rays"][0], wrong)
    assert tangents > TANGENT
    assert positions > POSITION
