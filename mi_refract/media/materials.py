"""Materials that no catalogue of glass has: air, water, fused silica, diamond; and the ratio of two indices."""

from __future__ import annotations

from dataclasses import replace

from mi_refract.numerics import Number

from .dispersion import Coefficients, Terms, sellmeier
from .medium import Medium


def _air(name: str, constant: float, terms: tuple[tuple[float, float], ...], valid: tuple[float, float]) -> Medium:
    """10⁸ (n − 1) = constant + Σ k/(k₀ − σ²), σ = 1/λ in µm⁻¹: k/(k₀ − σ²) = (k/k₀) λ²/(λ² − 1/k₀)."""
    pairs = tuple((f"B{i}", f"C{i}") for i in range(1, len(terms) + 1))
    values = {b: 1e-8 * k / k_0 for (b, _), (k, k_0) in zip(pairs, terms, strict=True)}
    values |= {c: 1e6 / k_0 for (_, c), (_, k_0) in zip(pairs, terms, strict=True)}
    return Medium(name, Terms(1, 1 + 1e-8 * constant, resonances=pairs), values, valid, "vacuum", is_air=True)


MATERIALS = {
    medium.name: medium
    for medium in (
        # Dry, 15 °C, 101325 Pa, 450 ppm CO₂: P. E. Ciddor, Applied Optics 35 (1996), 1566.
        _air("AIR:ciddor", 0.0, ((5792105.0, 238.0185), (167917.0, 57.362)), (230.0, 1690.0)),
        # Dry, 15 °C, 101325 Pa, 300 ppm CO₂: B. Edlén, Metrologia 2 (1966), 71.
        _air("AIR:edlen", 8342.13, ((2406030.0, 130.0), (15997.0, 38.9)), (200.0, 1700.0)),
        # F. Peter, Zeitschrift für Physik 15 (1923), 358, measured from 226 to 644 nm. Towards long wavelengths the
        # formula tends to 2.3804, where 2.38 is measured: the crystal has no resonance up to 2500 nm.
        Medium("MATERIAL:diamond", *sellmeier((0.3306, 4.3356, 175.0, 106.0), squared=True), (226.0, 2500.0)),
        # At 20 °C: I. H. Malitson, J. Opt. Soc. Am. 55 (1965), 1205.
        Medium(
            "MATERIAL:fused-silica",
            *sellmeier((0.6961663, 0.4079426, 0.8974794, 68.4043, 116.2414, 9896.161), squared=True),
            (210.0, 3710.0),
            "air",
        ),
        # At 20.0 °C: M. Daimon and A. Masumura, Applied Optics 46 (2007), 3811; λ in µm there.
        Medium(
            "MATERIAL:water",
            *sellmeier(
                (
                    *(5.684027565e-1, 1.726177391e-1, 2.086189578e-2, 1.130748688e-1),
                    *(1e6 * c for c in (5.101829712e-3, 1.821153936e-2, 2.620722293e-2, 1.069792721e1)),
                )
            ),
            (182.0, 1129.0),
            "vacuum",
        ),
    )
}
_CIDDOR = MATERIALS["AIR:ciddor"]
# What catalogues of glass have around their samples: 20 °C, 101325 Pa, dry. n − 1 is proportional to the density, here
# that of an ideal gas: within 2e-8 of Ciddor's own tables.
LABORATORY_AIR = replace(
    _CIDDOR,
    name="air at 20 °C",
    coefficients={k: x * (288.15 / 293.15 if k.startswith("B") else 1) for k, x in _CIDDOR.coefficients.items()},
)


def relative_index(
    inside: Medium,
    outside: Medium,
    wavelength: Number,
    inside_coefficients: Coefficients | None = None,
    outside_coefficients: Coefficients | None = None,
) -> Number:
    """n_inside / n_outside at a wavelength in nm; NaN, for floats as well, where one of them has no index.

    Beside an index that is relative to air, air has the index 1. Where the other one is relative to vacuum, the former
    is multiplied by the index of air at 20 °C and 101325 Pa.
    """
    n_inside = inside.index_or_nan(wavelength, inside_coefficients)
    n_outside = outside.index_or_nan(wavelength, outside_coefficients)
    if {inside.relative_to, outside.relative_to} != {"air", "vacuum"}:
        return n_inside / n_outside
    air = LABORATORY_AIR.index_or_nan(wavelength)
    if outside.relative_to == "vacuum":
        return n_inside + 0 * n_outside if outside.is_air else n_inside * air / n_outside
    return 1 / n_outside + 0 * n_inside if inside.is_air else n_inside / (n_outside * air)
