"""A double Gauss, traced exactly by CODE V, retraced surface by surface with every formula in float64."""

import drjit as dr
import pytest

from mi_refract import FORMULAS
from validation.reference import optical_systems


def refract(formula):
    """A formula on scalar arrays, ray by ray, as a system asks for it."""

    def by_rows(a, n, k):
        vector, found = dr.scalar.Array3f64, []
        for a_i, n_i in zip(a.astype(float), n.astype(float), strict=True):
            b, transmitted = formula(vector(a_i), vector(n_i), float(k))
            assert transmitted
            found.append(list(b))
        return optical_systems.vectors(*zip(*found, strict=True))

    return by_rows


@pytest.mark.parametrize("name", FORMULAS)
def test_every_formula_retraces_the_lens_within_the_print(name):
    assert optical_systems.off_print(refract(FORMULAS[name])) <= 1


def test_the_print_is_that_of_nine_rays_through_eleven_surfaces():
    path = optical_systems.double_gauss().path()
    assert path.places.shape == path.directions.shape == (11, 9, 3)


@pytest.mark.parametrize("column", [0, 1, 2])
def test_a_prescription_off_in_the_fifth_digit_is_seen(column):
    wrong = [list(surface) for surface in optical_systems.double_gauss_data()["prescription"]]
    wrong[2][column] *= 1 + 1e-5
    assert optical_systems.off_print(optical_systems.snell, wrong) > 1
