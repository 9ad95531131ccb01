"""Standard numbers of refraction: published or closed-form values to check any renderer against.

`NUMBERS` is the table, by name. A `StandardNumber` has a law that is evaluated here in extended precision, without code
of the package; the digits that a source prints, if an available source prints any; the given and the fitted parameters.
`rows()` returns the same as plain data, one dictionary per number, with the keys

| key | content |
|---|---|
| `name`, `kind`, `unit` | unique name; the quantity, a key of `KINDS`; "°", "mm" or "" |
| `value` | float64, rounded once |
| `printed`, `printed_value`, `printed_half_unit` | the source's digits; their number; half a unit of the last digit |
| `given` | name → number: all parameters of the law; angles in degrees, wavelengths in nm |
| `law`, `source`, `fitted` | formula; source of the law and the digits; what was fitted to what, "" for nothing |
| `off_print` | value − printed_value |

For numbers that no source prints, the values are "" or null. All values can be passed to `json.dumps`.

**Slabs.** Incident light is unpolarised. Light behind a boundary is polarised, so the transmittance is the mean over
both polarisations. A renderer without polarisation takes the mean at each boundary: another number, which is the same
at normal incidence only.

**CIE 171:2006, 5.5 and 5.10, clear glass of 6 mm.** As quoted, the report defines the directional transmittance by the
polynomial of Tregenza and Sharples' algorithm 2.34; the values are those of `CIE_POLYNOMIAL`. The polynomial is a fit:
its values rise from 0° to 20°, unlike those of any plane slab. So the index 1.52 is given (Radiance's for window
glass), the absorption of the glass is fitted here to the nine printed values by least squares, and `off_print` has the
residual of each: at most 0.0021. A renderer is compared with `value`.

Left out, for lack of a source or a derivation: the illuminances of the CIE's cases, which depend on the sky and the
room; and measured indices of water by wavelength. Also left out: the sample GLSL code of KHR_materials_dispersion,
which is not normative: its three indices are not those of a glass at any wavelengths.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import closed_forms, optical_systems

STEP = 1e-6  # step of difference quotients, relative or in degrees; rounding errors are 1e-13 in extended precision
CIE_INDEX = 1.52
CIE_POLYNOMIAL = -0.028378, 3.156075, -3.058376, -1.428919, 4.014235, -1.775827  # of powers of the cosine, from 0
CIE_PRINTED = "0.8788", "0.8796", "0.8799", "0.8759", "0.8661", "0.8476", "0.8018", "0.6828", "0.4233"  # 0, 10, … 80°
LINES = {"C": 656.2725, "d": 587.5618, "F": 486.1327}  # nm
# B1, B2, B3, then C1, C2, C3 in µm², and n at C, d and F, from the data sheets.
GLASSES = {
    "N-BK7": (
        (1.03961212, 0.231792344, 1.01046945, 0.00600069867, 0.0200179144, 103.560653),
        {"C": "1.51432", "d": "1.51680", "F": "1.52238"},
    ),
    "F2": (
        (1.34533359, 0.209073176, 0.937357162, 0.00997743871, 0.0470450767, 111.886764),
        {"C": "1.61503", "d": "1.62004", "F": "1.63208"},
    ),
    "N-SF11": (
        (1.73759695, 0.313747346, 1.89878101, 0.013188707, 0.0623068142, 155.23629),
        {"C": "1.77596", "d": "1.78472", "F": "1.80651"},
    ),
}
KINDS = {
    "transmittance": "transmittance of plane-parallel plates in air, from air to air, with all inner reflections",
    "transmittance, unpolarised": "the same if each boundary transmits the mean of both polarisations",
    "deviation": "minimum deviation of a ray through a prism",
    "rainbow": "angle between the rainbow and the antisolar point",
    "Brewster's angle": "angle of incidence at which no light polarised in the plane of incidence is reflected",
    "critical angle": "angle of incidence beyond which all light is reflected",
    "retardation": "phase difference between the polarisations after total internal reflections",
    "diffuse": "share of light of equal radiance from all directions that a plane boundary reflects or transmits",
    "index": "index of a glass at a wavelength, divided by that of air",
    "double Gauss": "a ray of CODE V's trace behind the last surface: mm, or the slope dy/dz",
}


@dataclass(frozen=True)
class StandardNumber:
    """A number, `law(**given)`. `printed`: the source's digits, "" if no available source prints it."""

    name: str
    kind: str
    law: Callable[..., Any]
    given: Mapping[str, float]
    formula: str
    source: str
    printed: str = ""
    fitted: str = ""
    unit: str = ""
    half_unit: float | None = None  # half a unit of the last printed digit, if it does not follow from the digits
    medium: str = ""  # of an index by wavelength: the plugin's parameter, a format string for `given`

    @functools.cached_property
    def value(self) -> float:
        """The law in extended precision, rounded to float64."""
        return float(self.at())

    def at(self, **other: float) -> Any:
        """Return the law in extended precision, with some of the given values replaced."""
        return np.longdouble(self.law(**{**self.given, **other}))

    def slope(self, name: str) -> float:
        """Return |∂value/∂given|, for angles per degree, by central differences."""
        x, step = self.given[name], STEP * max(1.0, abs(self.given[name]))
        return float(abs(self.at(**{name: x + step}) - self.at(**{name: x - step}))) / (2 * step)

    @property
    def print_reading(self) -> tuple[float, float] | None:
        """The printed number, and half a unit of its last digit; None without one."""
        if not self.printed:
            return None
        return float(self.printed), self.half_unit or 0.5 * 10.0 ** -len(self.printed.partition(".")[2])

    def as_dict(self) -> dict[str, Any]:
        """Return plain data: see the module."""
        printed_value, half_unit = self.print_reading or (None, None)
        return {
            "name": self.name,
            "kind": self.kind,
            "unit": self.unit,
            "value": self.value,
            "printed": self.printed,
            "printed_value": printed_value,
            "printed_half_unit": half_unit,
            "given": {name: float(x) for name, x in self.given.items()},
            "law": self.formula,
            "source": self.source,
            "fitted": self.fitted,
            "off_print": None if printed_value is None else self.value - printed_value,
        }


# Laws ------------------------------------------------------------------------------------------------------------


def _radians(degrees: Any) -> Any:
    return np.asarray(degrees, np.longdouble) * closed_forms.HALF_TURN / 180


def _degrees(radians: Any) -> Any:
    return radians * 180 / closed_forms.HALF_TURN


def reflectances(n: Any, incidence: Any) -> tuple[np.ndarray, Any]:
    """Return R_s and R_p of a boundary to an index n, and the cosine behind it; incidence in degrees."""
    angle, n = _radians(incidence), np.longdouble(n)
    outside, within = np.cos(angle), np.sqrt(1 - (np.sin(angle) / n) ** 2)
    s, p = (outside - n * within) / (outside + n * within), (n * outside - within) / (n * outside + within)
    return np.array([s * s, p * p]), within


def polarised_plates(n: Any, incidence: Any, count: float = 1, absorbance: Any = 0.0, together: bool = False) -> Any:
    """Return the transmittance of `count` parallel plates in air for s and p.

    One plate: T = (1 − R)² a/(1 − R² a²), R' = R + a² R (1 − R)²/(1 − R² a²), a = exp(−σ d/cosθ_t), where the
    absorbance σ d is that at normal incidence. Two plates in series: T = T₁ T₂/(1 − R₁' R₂'), R' = R₁' + T₁² R₂'/(1 −
    R₁' R₂'). Without absorption count plates transmit (1 − R)/(1 + (2 count − 1) R). `together`: one entry, for a
    renderer in which R is the mean of both polarisations at each boundary.
    """
    r, a = _boundary(n, incidence, absorbance, together)
    one_t, one_r = (1 - r) ** 2 * a / (1 - (r * a) ** 2), r + a * a * r * (1 - r) ** 2 / (1 - (r * a) ** 2)
    all_t, all_r = one_t, one_r
    for _ in range(round(count) - 1):
        all_t, all_r = all_t * one_t / (1 - all_r * one_r), all_r + all_t * all_t * one_r / (1 - all_r * one_r)
    return all_t


def _boundary(n: Any, incidence: Any, absorbance: Any, together: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return R, and the share of light that one passage through a plate transmits."""
    r, within = reflectances(n, incidence)
    r = r.mean(keepdims=True) if together else r
    return r, np.exp(-np.longdouble(absorbance) / within) + 0 * r


def paths_through(most: int, **given: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the light that leaves the plates of `polarised_plates` after 1 … `most` boundaries, and the light left.

    The light is propagated from boundary to boundary: from boundary i of 2 count to i + 1 or i − 1.
    """
    r, a = _boundary(given["n"], given["incidence"], given.get("absorbance", 0.0), given.get("together", False))
    boundaries, leaving = 2 * round(given.get("count", 1)), []
    forward, backward = np.zeros((2, boundaries, len(r)), np.longdouble)
    forward[0] = 1
    for _ in range(most):
        next_forward, next_backward = np.zeros_like(forward), np.zeros_like(backward)
        leaves = np.zeros_like(r)
        for i in range(boundaries):
            ahead, behind = (1 - r) * forward[i] + r * backward[i], r * forward[i] + (1 - r) * backward[i]
            glass_ahead = i % 2 == 0
            if i + 1 < boundaries:
                next_forward[i + 1] = ahead * (a if glass_ahead else 1)
            else:
                leaves = ahead
            if i > 0:
                next_backward[i - 1] = behind * (1 if glass_ahead else a)
        forward, backward = next_forward, next_backward
        leaving.append(leaves)
    return np.array(leaving), (forward + backward).sum(0)


def plates(**given: Any) -> Any:
    """Return the mean over both polarisations of `polarised_plates`."""
    return polarised_plates(**given).mean()


def deviation(n: Any, apex: Any) -> Any:
    """Return the minimum deviation 2 asin(n sin(A/2)) − A, in degrees."""
    angle = _radians(apex)
    return _degrees(2 * closed_forms.least_deviated(angle, np.longdouble(n)) - angle)


def rainbow(n: Any, order: float) -> Any:
    """Return the angle from the antisolar point in degrees, after `order` reflections, 1 or 2."""
    n = np.longdouble(n)
    deflection = closed_forms.deflection(closed_forms.rainbow_incidence(n, order), n, order)
    return abs(_degrees(deflection) - 180)


def brewster(n: Any) -> Any:
    """Return atan n in degrees; `n`: index of the medium behind over that in front."""
    return _degrees(np.arctan(np.longdouble(n)))


def critical(n: Any) -> Any:
    """Return asin 1/n in degrees; `n`: index of the denser over that of the thinner medium."""
    return _degrees(np.arcsin(1 / np.longdouble(n)))


def retardation(n: Any, incidence: Any, reflections: float) -> Any:
    """Return the retardation of total reflections, tan(δ/2) = cosθ √(sin²θ − n⁻²)/sin²θ each, in degrees."""
    angle, n = _radians(incidence), np.longdouble(n)
    sine2 = np.sin(angle) ** 2
    return _degrees(2 * reflections * np.arctan(np.cos(angle) * np.sqrt(sine2 - 1 / n**2) / sine2))


def retarding_incidence(n: Any, each: Any, steep: bool) -> Any:
    """Return the incidence in degrees at which one reflection retards by `each` degrees.

    With t = tan(each/2) and x = sin²θ, (1 + t²) x² − (1 + n⁻²) x + n⁻² = 0: the smaller or, if `steep`, larger root.
    """
    t2, m = np.tan(_radians(each) / 2) ** 2, 1 / np.longdouble(n) ** 2
    half = np.sqrt((1 + m) ** 2 - 4 * (1 + t2) * m)
    x = ((1 + m) + (half if steep else -half)) / (2 * (1 + t2))
    return _degrees(np.arcsin(np.sqrt(x)))


def diffuse(n: float, outside: float, passed: float) -> Any:
    """Return R, or T if `passed` is 1, of diffuse light from outside if `outside` is 1, otherwise from inside."""
    reflected = closed_forms.hemispherical(float(n))["outside" if outside else "inside"]
    return 1 - reflected if passed else reflected


def sellmeier(coefficients: tuple[float, ...], nm: Any) -> Any:
    """Return n from n² = 1 + Σ B λ²/(λ² − C), λ in µm."""
    x = (np.longdouble(nm) / 1000) ** 2
    b, c = (np.array(half, np.longdouble) for half in (coefficients[:3], coefficients[3:]))
    return np.sqrt(1 + (b * x / (x - c)).sum())


def khronos(n_d: Any, abbe: Any, nm: Any) -> Any:
    """Return max(n_d + (n_d − 1)/V_d (523655/λ² − 1.5168), 1), the normative formula."""
    n_d = np.longdouble(n_d)
    return max(n_d + (n_d - 1) / abbe * (523655 / np.longdouble(nm) ** 2 - np.longdouble("1.5168")), 1)


@functools.cache
def _lens() -> Any:
    return optical_systems.double_gauss().path()


def behind_the_lens(path: optical_systems.Path, ray: float, slope: float) -> Any:
    """Return y in mm, or dy/dz if `slope` is 1, of a ray behind the last surface."""
    y, b = path.places[-1][round(ray), 1], path.directions[-1][round(ray)]
    return b[1] / b[2] if slope else y


def lens(ray: float, slope: float) -> Any:
    """Return y or dy/dz of a ray behind the double Gauss, by Snell's law in extended precision."""
    return behind_the_lens(_lens(), ray, slope)


@functools.cache
def cie_absorbance() -> float:
    """Return σ d of the glass of CIE 171's case: a least-squares fit to the nine transmittances, by Gauss–Newton."""
    printed, angles, x = np.array(CIE_PRINTED, float), range(0, 90, 10), 0.04
    for _ in range(8):
        middle, above, below = (
            np.array([plates(n=CIE_INDEX, incidence=angle, absorbance=x + h) for angle in angles], float)
            for h in (0, 1e-5, -1e-5)
        )
        slope = (above - below) / 2e-5
        x += float(slope @ (printed - middle) / (slope @ slope))
    return round(x, 8)


# Rays ------------------------------------------------------------------------------------------------------------


def prism(numbers: Sequence[StandardNumber]) -> optical_systems.System:
    """Return a prism with a ray for each number of its kind, at the incidence of minimum deviation."""
    apex = _radians([number.given["apex"] for number in numbers])
    index = np.array([_index(number) for number in numbers])
    return optical_systems.prism(apex, closed_forms.least_deviated(apex, index), index=index)


def _index(number: StandardNumber) -> Any:
    if "n" in number.given:
        return np.longdouble(number.given["n"])
    return sellmeier(GLASSES[number.medium.partition(":")[2]][0], number.given["nm"])


def drop(numbers: Sequence[StandardNumber]) -> optical_systems.System:
    """Return a drop with a ray for each rainbow of one order, at the incidence of stationary deflection."""
    index, order = np.array([number.given["n"] for number in numbers], np.longdouble), numbers[0].given["order"]
    return optical_systems.drop(round(order), closed_forms.rainbow_incidence(index, order), index)


def deviated(a: Any, b: Any) -> Any:
    """Return the clockwise angles between directions (N × 3) in the plane x = 0, in degrees."""
    return _degrees(np.arctan2(a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1], a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]))


def from_antisolar(a: Any, b: Any) -> Any:
    """Return the angles from the antisolar point in degrees, for sunlight along a that leaves along b."""
    return _degrees(np.arctan2(optical_systems.length(np.cross(a, b))[:, 0], -optical_systems.dot(a, b)[:, 0]))


# The table -------------------------------------------------------------------------------------------------------

PILE = (
    "Stokes 1862, On the intensity of the light reflected from or transmitted through a pile of plates (Proc. R. Soc. "
    "11, 545); Born and Wolf, Principles of Optics, 1.5.2 (Fresnel's formulae)"
)
CIE = (
    "CIE 171:2006, 5.5 and 5.10, as quoted in Radiance's mailing list, Glass transmittance, 2017-03-06; Tregenza and "
    "Sharples, Daylighting Algorithms (1993), 2.34, Directional transmittance of clear glass"
)
PRISM = "Born and Wolf, Principles of Optics, 4.7.2"
BOW = "Descartes, Les Météores (1637), VIII; Airy 1838 (Trans. Camb. Phil. Soc. 6, 379)"
RHOMB = "Fresnel 1823; Born and Wolf, Principles of Optics, 1.5.4, eq. (61)"
DIFFUSE = "Walsh 1926; Duntley 1942 (J. Opt. Soc. Am. 32, 61); Judd 1942 (J. Res. NBS 29, 329)"
SCHOTT = "Schott, optical glass data sheets: coefficients of Sellmeier's formula and printed indices"
KHRONOS = "Khronos, KHR_materials_dispersion, ratified 2024"
CODE_V = "CODE V's listing ag_dblgauss.lis, as ray-optics has it: validation/reference/double_gauss_codev.json"
APEX = 60.0


def _table() -> Iterator[StandardNumber]:
    one, pile = "(1 − R)/(1 + R), mean of s and p", "(1 − R)/(1 + (2m − 1) R), m plates, mean of s and p"
    for angle in (0.0, 30.0, 45.0, 60.0):
        given = {"n": 1.52, "incidence": angle}
        yield StandardNumber(f"slab, n = 1.52, {angle:g}°", "transmittance", plates, given, one, PILE)
    for angle in (0.0, 45.0):
        given = {"n": 1.52, "incidence": angle, "count": 2}
        yield StandardNumber(f"2 slabs, n = 1.52, {angle:g}°", "transmittance", plates, given, pile, PILE)
    for count, angle in ((1, 30.0), (1, 45.0), (1, 60.0), (4, 0.0)):
        law = functools.partial(plates, together=True)
        given = {"n": 1.52, "incidence": angle, "count": count}
        slabs = "slab" if count == 1 else f"{count} slabs"
        name = f"{slabs} without polarisation, n = 1.52, {angle:g}°"
        text = f"{pile.split(',')[0]}, R the mean of s and p"
        yield StandardNumber(name, "transmittance, unpolarised", law, given, text, PILE)
    for angle, printed in zip(range(0, 90, 10), CIE_PRINTED, strict=True):
        given = {"n": CIE_INDEX, "incidence": float(angle), "absorbance": cie_absorbance()}
        fit = "σ d, by least squares to the nine printed values; the index is given"
        text = "(1 − R)² a/(1 − R² a²), a = exp(−σ d/cosθ_t), mean of s and p"
        name = f"CIE 171 clear glass, {angle}°"
        yield StandardNumber(name, "transmittance", plates, given, text, CIE, printed=printed, fitted=fit)
    for n in (1.5, 1.5168, 1.52):
        name, given, text = f"prism of 60°, n = {n:g}", {"n": n, "apex": APEX}, "2 asin(n sin(A/2)) − A"
        yield StandardNumber(name, "deviation", deviation, given, text, PRISM, unit="°")
    for line, nm in LINES.items():
        law = functools.partial(_prism_of_glass, GLASSES["N-BK7"][0])
        text, source = "2 asin(n(λ) sin(A/2)) − A, Sellmeier's n(λ)", f"{PRISM}; {SCHOTT}"
        name = f"prism of 60°, N-BK7, line {line}"
        given, medium = {"nm": nm, "apex": APEX}, "SCHOTT:N-BK7"
        yield StandardNumber(name, "deviation", law, given, text, source, unit="°", medium=medium)
    for n in (1.3333, 1.3318, 1.3435):
        for order in (1, 2):
            text = f"|{order}π + 2i − {2 * (order + 1)}r − π|, cos i = √((n² − 1)/{order * (order + 2)})"
            name = f"rainbow of order {order}, n = {n:g}"
            yield StandardNumber(name, "rainbow", rainbow, {"n": n, "order": order}, text, BOW, unit="°")
    for where, n in (("air to n = 1.5", 1.5), ("n = 1.5 to air", 1 / 1.5)):
        source = "Brewster 1815 (Phil. Trans. 105, 125); Born and Wolf, Principles of Optics, 1.5.3"
        name = f"Brewster's angle, {where}"
        yield StandardNumber(name, "Brewster's angle", brewster, {"n": n}, "atan n", source, unit="°")
    for n in (1.5, 1.3333):
        source = "Born and Wolf, Principles of Optics, 1.5.4"
        name = f"critical angle, n = {n:g} to air"
        yield StandardNumber(name, "critical angle", critical, {"n": n}, "asin 1/n", source, unit="°")
    law_text = "2m atan(cosθ √(sin²θ − n⁻²)/sin²θ), m reflections"
    for steep, near in ((False, "48°37′"), (True, "54°37′")):
        given = {"n": 1.51, "incidence": float(retarding_incidence(1.51, 45, steep)), "reflections": 2.0}
        name = f"Fresnel's rhomb, n = 1.51, {near}"
        yield StandardNumber(name, "retardation", retardation, given, law_text, RHOMB, unit="°")
    flattest = float(_degrees(np.arcsin(np.sqrt(2 / (np.longdouble(1.51) ** 2 + 1)))))  # where the law is stationary
    given = {"n": 1.51, "incidence": flattest, "reflections": 1.0}
    yield StandardNumber("largest retardation, n = 1.51", "retardation", retardation, given, law_text, RHOMB, unit="°")
    for n in (1.5, 1.333):
        for outside in (True, False):
            for passed in (False, True):
                side, what = "outside" if outside else "inside", "transmittance" if passed else "reflectance"
                given = {"n": n, "outside": float(outside), "passed": float(passed)}
                text = "see validation.reference.closed_forms.hemispherical; 1 − R_i = (1 − R_e)/n², T = 1 − R"
                name = f"diffuse {what}, n = {n:g}, from {side}"
                yield StandardNumber(name, "diffuse", diffuse, given, text, DIFFUSE)
    for glass, (coefficients, printed_at) in GLASSES.items():
        for line, printed in printed_at.items():
            law, text = functools.partial(sellmeier, coefficients), "n² = 1 + Σ B λ²/(λ² − C)"
            name, given, medium = f"index of {glass}, line {line}", {"nm": LINES[line]}, f"SCHOTT:{glass}"
            yield StandardNumber(name, "index", law, given, text, SCHOTT, printed=printed, medium=medium)
    for line, nm in (("C", 656.27), ("F", 486.13)):
        given, text = {"n_d": 2.42, "abbe": 55.0, "nm": nm}, "n_d + (n_d − 1)/V_d (523655/λ² − 1.5168), at least 1"
        name, source = f"glTF dispersion, n_{line}", f"{KHRONOS}, Overview (normative)"
        yield StandardNumber(name, "index", khronos, given, text, source, medium="abbe({n_d}, {abbe})")
    for ray, field_angle in ((1, 10), (5, 14)):
        for slope, what, unit in ((0.0, "y", "mm"), (1.0, "dy/dz", "")):
            numbers = optical_systems.double_gauss_data()["rays"][ray]["surfaces"][-1]
            printed = f"{numbers[4 if slope else 1]:.6f}"
            half = optical_systems.TANGENT if slope else optical_systems.POSITION
            name = f"double Gauss, chief ray of {field_angle}°, {what}"
            given = {"ray": float(ray), "slope": slope}
            text = "Snell's law at eleven surfaces"
            yield StandardNumber(
                name, "double Gauss", lens, given, text, CODE_V, printed=printed, unit=unit, half_unit=half
            )


def _prism_of_glass(coefficients: tuple[float, ...], nm: Any, apex: Any) -> Any:
    return deviation(sellmeier(coefficients, nm), apex)


NUMBERS: dict[str, StandardNumber] = {number.name: number for number in _table()}


def rows() -> list[dict[str, Any]]:
    """Return the table as plain data: see the module."""
    return [number.as_dict() for number in NUMBERS.values()]
