"""Fresnel's equations against their textbook form, evaluated at 400 bits for the exact inputs."""

import drjit as dr
import numpy as np
import pytest
from flint import acb, arb, ctx

from mi_refract import fresnel

# (cos θ_i, k): generic, near-normal, grazing, matched to 1e-7, Brewster, both sides of the critical angle, extreme k.
CASES = {
    "generic": [(0.3, 1 / 1.5), (0.8, 1.5), (0.95, 1.2), (0.5, 0.4)],
    "near-normal": [(1 - 2.0**-20, 1.5), (1.0, 0.7), (1.0, 1.5)],
    "grazing": [(1e-6, 0.7), (1e-3, 0.5)],
    "matched": [(0.3, 1 + 2.0**-23), (0.6, 1 - 2.0**-20), (1e-3, 1 - 2.0**-20), (0.9, 1 + 2.0**-10)],
    "Brewster": [(1 / np.sqrt(1 + 1.5**2), 1 / 1.5), (1.5 / np.sqrt(1 + 1.5**2), 1.5), (0.6, 0.75)],
    "critical": [(np.sqrt(1 - 1 / 1.5**2) + d, 1.5) for d in (1e-2, 1e-4, 1e-6)],
    "total": [(np.sqrt(1 - 1 / 1.5**2) - d, 1.5) for d in (1e-6, 1e-3, 0.3)] + [(0.1, 1.2), (0.5, 100.0)],
    "extreme": [(0.5, 1e-4), (1 - 1e-7, 100.0), (0.2, 1e-2)],
}


def textbook(cos_i, k):
    """(r_s, r_p) as printed in books, with the square root on the branch of a decaying wave, at 400 bits."""
    with ctx.workprec(400):
        c, k = acb(arb(float(cos_i))), acb(arb(float(k)))
        radicand = 1 - k**2 * (1 - c**2)
        cos_t = radicand.sqrt() if radicand.real >= 0 else -acb(0, 1) * (-radicand).sqrt()
        return (k * c - cos_t) / (k * c + cos_t), (c - k * cos_t) / (c + k * cos_t)


def evaluate(setting, cases):
    """Our R, T, r_s, r_p for rounded inputs, and those inputs."""
    number = dr.value_t(setting.vector)
    cos_i, k = (np.array(x, dtype=setting.precision) for x in zip(*cases, strict=True))

    def ask(c, ratio):
        cos_t, transmitted = fresnel.refracted_cosine(c, ratio)
        r = fresnel.reflectance(c, cos_t, transmitted, ratio)
        t = fresnel.transmittance(c, cos_t, transmitted, ratio)
        return [np.array(x, dtype=complex) for x in (r, t, *fresnel.amplitudes(c, ratio))]

    if setting.backend == "scalar":
        each = [ask(float(c), float(x)) for c, x in zip(cos_i, k, strict=True)]
        found = [np.stack(parts, axis=-1) for parts in zip(*each, strict=True)]
    else:
        found = ask(number(cos_i), number(k))
    r, t, s, p = (np.broadcast_to(np.ravel(x), len(cases)) for x in found)
    return cos_i, k, r.real, t.real, s, p


@pytest.mark.parametrize("case", CASES)
def test_reflectance_and_transmittance_keep_their_relative_accuracy(case, setting):
    cos_i, k, r, t, _, _ = evaluate(setting, CASES[case])
    for i in range(len(cos_i)):
        r_s, r_p = textbook(cos_i[i], k[i])
        with ctx.workprec(400):
            exact = (abs(r_s) ** 2 + abs(r_p) ** 2) / 2
            complement = 1 - exact
            total = case == "total"
            assert abs(arb(r[i]) / exact - 1) < 12 * setting.roundoff
            assert t[i] == 0 if total else abs(arb(t[i]) / complement - 1) < 12 * setting.roundoff


@pytest.mark.parametrize("case", CASES)
def test_amplitudes_carry_sign_and_phase(case, setting):
    cos_i, k, _, _, s, p = evaluate(setting, CASES[case])
    for i in range(len(cos_i)):
        for ours, exact in zip((s, p), textbook(cos_i[i], k[i]), strict=True):
            with ctx.workprec(400):
                error = abs(acb(ours[i].real, ours[i].imag) - exact)
                assert error < 12 * setting.roundoff * (abs(exact) if case != "Brewster" else 1)


def test_brewsters_angle_in_double_words(setting):
    """cos = 3/5, k = 3/4 is Brewster's angle but for the rounding of 3/5: what is left of r_p keeps its digits."""
    _, _, _, _, _, p = evaluate(setting, [(0.6, 0.75)])
    cos_i = float(setting.precision(0.6))
    _, exact = textbook(cos_i, 0.75)
    assert abs(p[0] - complex(exact)) <= 8 * setting.roundoff * abs(complex(exact))


def test_a_difference_form_would_fail():
    """What the products are for: at k = 1 + 2⁻²³ the textbook's difference is wrong in the second digit in float32."""
    k, c = np.float32(1 + 2.0**-23), np.float32(0.3)
    cos_t = np.sqrt(np.float32(1) - k * k * (np.float32(1) - c * c))
    printed = ((k * c - cos_t) / (k * c + cos_t)) ** 2
    exact = float(abs(textbook(c, k)[0]) ** 2)
    assert abs(printed / exact - 1) > 0.01


def test_mueller_matrices_conserve_energy_and_are_physical(setting):
    number = float if setting.backend == "scalar" else dr.value_t(setting.vector)
    for cos_i, k in CASES["generic"] + CASES["total"]:
        c, ratio = number(cos_i), number(k)
        cos_t, transmitted = fresnel.refracted_cosine(c, ratio)
        r = np.array([[np.array(x).ravel()[0] for x in row] for row in fresnel.mueller_reflection(c, ratio)], float)
        t = fresnel.mueller_transmission(c, cos_t, transmitted, ratio)
        t = np.array([[np.array(x).ravel()[0] for x in row] for row in t], float)
        assert r[0, 0] + t[0, 0] == pytest.approx(1, abs=12 * setting.roundoff)
        for m in (r, t):
            # Lossless boundaries keep a fully polarised beam fully polarised: m00² − m01² = m22² + m32².
            assert m[0, 0] ** 2 - m[0, 1] ** 2 == pytest.approx(m[2, 2] ** 2 + m[3, 2] ** 2, abs=24 * setting.roundoff)


def test_nan_is_neither_a_mirror_nor_a_window(setting):
    number = float if setting.backend == "scalar" else dr.value_t(setting.vector)
    nan = number(float("nan"))
    for cos_i, cos_t in ((nan, number(0.5)), (number(0.5), nan)):
        for value in (fresnel.reflectance(cos_i, cos_t, False, number(1.5)),
                      fresnel.transmittance(cos_i, cos_t, False, number(1.5))):  # fmt: skip
            assert np.isnan(np.array(value, float)).all()
