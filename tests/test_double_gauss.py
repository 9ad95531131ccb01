"""A double Gauss, traced exactly by CODE V, retraced surface by surface with every formula in float64."""

import drjit as dr
import numpy as np
import pytest

from mi_refract import FORMULAS
from validation import systems
from validation.directions import Setting
from validation.stability import Refractor

SCALAR = Setting("scalar float64", np.float64, dr.scalar.Array3f64)


@pytest.mark.parametrize("name", FORMULAS)
def test_every_formula_retraces_the_lens_within_the_print(name):
    refractor = Refractor(FORMULAS[name], SCALAR)
    assert systems.off_print(refractor) <= 1
    assert refractor.mirrored == 0


def test_the_print_is_that_of_nine_rays_through_eleven_surfaces():
    positions, directions = systems.retrace(systems.snell)
    assert positions.shape == directions.shape == (11, 9, 3)


@pytest.mark.parametrize("column", [0, 1, 2])
def test_a_prescription_off_in_the_fifth_digit_is_seen(column):
    wrong = [list(surface) for surface in systems.double_gauss_data()["prescription"]]
    wrong[2][column] *= 1 + 1e-5
    assert systems.off_print(systems.snell, wrong) > 1
