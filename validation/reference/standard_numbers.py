"""Standard numbers of refraction: published or closed-form values that any renderer can be checked against.

`NUMBERS` is the table, by name. A `StandardNumber` has a law that is evaluated here, in extended precision, by nothing
of the package; the digits that a source prints, where one in hand does; what is given and what is fitted. `rows()` is
the same as plain data, one dictionary a number, all of them with the keys

| key | content |
|---|---|
| `name`, `kind`, `unit` | unique name; what is asked, a key of `KINDS`; "°", "mm" or "" |
| `value` | float64, rounded once |
| `printed`, `printed_value`, `printed_half_unit` | as its source has it; as a number; half of its last digit |
| `given` | name → number: all that the law needs; angles in degrees, wavelengths in nm |
| `law`, `source`, `fitted` | formula; where law and digits are from; what was fitted to what, "" where all is given |
| `off_print` | value − printed_value |

where nothing is printed "" or null; all of it is as `json.dumps` takes it.

**Slabs.** Light is unpolarised when it arrives. What a boundary passes is polarised, so the transmittance is the mean
of those of both polarisations. A renderer without polarisation takes the mean at each boundary; that is another number,
and the same at normal incidence only.

**CIE 171:2006, 5.5 and 5.10, clear glass of 6 mm.** As it is quoted, the report defines the directional transmittance
by the polynomial of Tregenza and Sharples' algorithm 2.34; the values are `CIE_POLYNOMIAL`'s. They were fitted: they
rise from 0° to 20°, as no plane slab's do. So the index 1.52 is given (Radiance's for window glass), the absorption of
the glass is fitted here, by least squares to the nine printed values, and `off_print` says by how much each is missed:
by 0.0021 or less. A renderer is compared with `value`.

Left out, for want of a source or of a derivation: the illuminances of the CIE's cases, which are the sky's and the
room's; and measured indices of water by wavelength. And the sample of GLSL in KHR_materials_dispersion, which is not
normative: three indices, no index by wavelength that a glass could have.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import closed_forms, optical_systems

STEP = 1e-6  # of the difference quotients, relative or in degrees; extended precision leaves 1e-13 of them
CIE_INDEX = 1.52
CIE_POLYNOMIAL = -0.028378, 3.156075, -3.058376, -1.428919, 4.014235, -1.775827  # of powers of the cosine, from 0
CIE_PRINTED = "0.8788", "0.8796", "0.8799", "0.8759", "0.8661", "0.8476", "0.8018", "0.6828", "0.4233"  # 0, 10, … 80°
LINES = {"C": 656.2725, "d": 587.5618, "F": 486.1327}  # nm
# B1, B2, B3, and C1, C2, C3 in µm², and n at C, d and F, of the data sheets.
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
    "transmittance": "of plane-parallel plates in air, from air to air, all reflections within counted",
    "transmittance, unpolarised": "the same where each boundary passes the mean of both polarisations",
    "deviation": "of a ray through a prism at its least",
    "rainbow": "angle from the point opposite to the sun",
    "Brewster's angle": "of incidence, at which nothing of the light in the plane of incidence is reflected",
    "critical angle": "of incidence, beyond which all is reflected",
    "retardation": "of one polarisation against the other by total internal reflections",
    "diffuse": "share of light of equal radiance from all directions that a plane boundary reflects or passes",
    "index": "of a glass at a wavelength, over that of air",
    "double Gauss": "a ray of CODE V's trace, behind the last surface: mm, or the slope dy/dz",
}


@dataclass(frozen=True)
class StandardNumber:
    """`law(**given)` is the number; `printed`: as its source has it, "" where no source in hand prints it."""

    name: str
    kind: str
    law: Callable[..., Any]
    given: Mapping[str, float]
    formula: str
    source: str
    printed: str = ""
    fitted: str = ""
    unit: str = ""
    half_unit: float | None = None  # of the last printed digit, where it is not what the digits say
    medium: str = ""  # of an index by wavelength: the text that the plugin is given, with `given` in it

    @functools.cached_property
    def value(self) -> float:
        """The law in extended precision, rounded to float64."""
        return float(self.at())

    def at(self, **other: float) -> Any:
        """The law in extended precision, with some of what is given replaced."""
        return np.longdouble(self.law(**{**self.given, **other}))

    def slope(self, name: str) -> float:
        """|∂value/∂given|, of angles per degree: by central differences."""
        step = STEP * max(1.0, abs(self.given[name]))
        return float(abs(self.at(**{name: self.given[name] + step}) - self.at(**{name: self.given[name] - step}))) / (
            2 * step
        )

    @property
    def print_reading(self) -> tuple[float, float] | None:
        """What is printed, as a number, and half a unit of its last digit."""
        if not self.printed:
            return None
        return float(self.printed), self.half_unit or 0.5 * 10.0 ** -len(self.printed.partition(".")[2])

    def as_dict(self) -> dict[str, Any]:
        """Plain data: see the module."""
        read, half = self.print_reading or (None, None)
        return {
            "name": self.name,
            "kind": self.kind,
            "unit": self.unit,
            "value": self.value,
            "printed": self.printed,
            "printed_value": read,
            "printed_half_unit": half,
            "given": {name: float(x) for name, x in self.given.items()},
            "law": self.formula,
            "source": self.source,
            "fitted": self.fitted,
            "off_print": None if read is None else self.value - read,
        }


# Laws ------------------------------------------------------------------------------------------------------------


def _radians(degrees: Any) -> Any:
    return np.asarray(degrees, np.longdouble) * closed_forms.HALF_TURN / 180


def _degrees(radians: Any) -> Any:
    return radians * 180 / closed_forms.HALF_TURN


def reflectances(n: Any, incidence: Any) -> tuple[np.ndarray, Any]:
    """R_s and R_p of a boundary to an index n, and the cosine behind it; incidence in degrees."""
    angle, n = _radians(incidence), np.longdouble(n)
    outside, within = np.cos(angle), np.sqrt(1 - (np.sin(angle) / n) ** 2)
    s, p = (outside - n * within) / (outside + n * within), (n * outside - within) / (n * outside + within)
    return np.array([s * s, p * p]), within


def polarised_plates(n: Any, incidence: Any, count: float = 1, absorbance: Any = 0.0, together: bool = False) -> Any:
    """Transmittance of `count` parallel plates in air for s and p.

    One plate: T = (1 − R)² a/(1 − R² a²), R' = R + a² R (1 − R)²/(1 − R² a²), a = exp(−σ d/cosθ_t), with the absorbance
    σ d straight through it. Two that stand one behind the other: T = T₁ T₂/(1 − R₁' R₂'), R' = R₁' + T₁² R₂'/(1 − R₁'
    R₂'). Without absorption count plates pass (1 − R)/(1 + (2 count − 1) R). `together`: one entry, for a renderer in
    which R is the mean of both polarisations at each boundary.
    """
    r, a = _boundary(n, incidence, absorbance, together)
    through, back = (1 - r) ** 2 * a / (1 - (r * a) ** 2), r + a * a * r * (1 - r) ** 2 / (1 - (r * a) ** 2)
    t, b = through, back
    for _ in range(round(count) - 1):
        t, b = t * through / (1 - b * back), b + t * t * back / (1 - b * back)
    return t


def _boundary(n: Any, incidence: Any, absorbance: Any, together: bool) -> tuple[np.ndarray, np.ndarray]:
    """R, and what a way through a plate leaves."""
    r, within = reflectances(n, incidence)
    r = r.mean(keepdims=True) if together else r
    return r, np.exp(-np.longdouble(absorbance) / within) + 0 * r


def paths_through(most: int, **given: Any) -> tuple[np.ndarray, np.ndarray]:
    """What leaves plates as of `polarised_plates` after 1 … `most` boundaries; and what is still on its way then.

    Boundary by boundary: at the one of number i, of 2 count, light goes on to i + 1 or i − 1.
    """
    r, a = _boundary(given["n"], given["incidence"], given.get("absorbance", 0.0), given.get("together", False))
    last, passed = 2 * round(given.get("count", 1)), []
    onward, back = np.zeros((2, last, len(r)), np.longdouble)
    onward[0] = 1
    for _ in range(most):
        after, before = np.zeros_like(onward), np.zeros_like(back)
        leaves = np.zeros_like(r)
        for i in range(last):
            ahead, behind = (1 - r) * onward[i] + r * back[i], r * onward[i] + (1 - r) * back[i]
            glass_ahead = i % 2 == 0
            if i + 1 < last:
                after[i + 1] = ahead * (a if glass_ahead else 1)
            else:
                leaves = ahead
            if i > 0:
                before[i - 1] = behind * (1 if glass_ahead else a)
        onward, back = after, before
        passed.append(leaves)
    return np.array(passed), (onward + back).sum(0)


def plates(**given: Any) -> Any:
    """The mean of both polarisations of `polarised_plates`."""
    return polarised_plates(**given).mean()


def deviation(n: Any, apex: Any) -> Any:
    """2 asin(n sin(A/2)) − A, in degrees."""
    angle = _radians(apex)
    return _degrees(2 * closed_forms.least_deviated(angle, np.longdouble(n)) - angle)


def rainbow(n: Any, order: float) -> Any:
    """The angle from the antisolar point, in degrees, after `order` reflections, 1 or 2."""
    n = np.longdouble(n)
    turn = closed_forms.deflection(closed_forms.rainbow_incidence(n, order), n, order)
    return abs(_degrees(turn) - 180)


def brewster(n: Any) -> Any:
    """atan n, in degrees; `n`: of the medium behind over that in front."""
    return _degrees(np.arctan(np.longdouble(n)))


def critical(n: Any) -> Any:
    """asin 1/n, in degrees; `n`: of the denser over the rarer medium."""
    return _degrees(np.arcsin(1 / np.longdouble(n)))


def retardation(n: Any, incidence: Any, reflections: float) -> Any:
    """Degrees of retardation by `reflections` total reflections, tan(δ/2) = cosθ √(sin²θ − n⁻²)/sin²θ each."""
    angle, n = _radians(incidence), np.longdouble(n)
    sine2 = np.sin(angle) ** 2
    return _degrees(2 * reflections * np.arctan(np.cos(angle) * np.sqrt(sine2 - 1 / n**2) / sine2))


def retarding_incidence(n: Any, each: Any, steep: bool) -> Any:
    """Where one reflection retards by `each` degrees: with t = tan(each/2), (1 + t²) x² − (1 + n⁻²) x + n⁻² = 0.

    x = sin²θ; the smaller or, if `steep`, the larger root. In degrees.
    """
    t2, m = np.tan(_radians(each) / 2) ** 2, 1 / np.longdouble(n) ** 2
    half = np.sqrt((1 + m) ** 2 - 4 * (1 + t2) * m)
    x = ((1 + m) + (half if steep else -half)) / (2 * (1 + t2))
    return _degrees(np.arcsin(np.sqrt(x)))


def diffuse(n: float, outside: float, passed: float) -> Any:
    """R or, where `passed` is 1, T of diffuse light from outside, where `outside` is 1, or from inside."""
    reflected = closed_forms.hemispherical(float(n))["outside" if outside else "inside"]
    return 1 - reflected if passed else reflected


def sellmeier(coefficients: tuple[float, ...], nm: Any) -> Any:
    """n² = 1 + Σ B λ²/(λ² − C), λ in µm."""
    x = (np.longdouble(nm) / 1000) ** 2
    b, c = (np.array(half, np.longdouble) for half in (coefficients[:3], coefficients[3:]))
    return np.sqrt(1 + (b * x / (x - c)).sum())


def khronos(n_d: Any, abbe: Any, nm: Any) -> Any:
    """max(n_d + (n_d − 1)/V_d (523655/λ² − 1.5168), 1): the normative formula."""
    n_d = np.longdouble(n_d)
    return max(n_d + (n_d - 1) / abbe * (523655 / np.longdouble(nm) ** 2 - np.longdouble("1.5168")), 1)


@functools.cache
def _lens() -> Any:
    return optical_systems.double_gauss().path()


def behind_the_lens(path: optical_systems.Path, ray: float, slope: float) -> Any:
    """y in mm of a ray's path behind the last surface or, where `slope` is 1, dy/dz."""
    y, b = path.places[-1][round(ray), 1], path.directions[-1][round(ray)]
    return b[1] / b[2] if slope else y


def lens(ray: float, slope: float) -> Any:
    """The same of a ray through the double Gauss, by Snell's law in extended precision."""
    return behind_the_lens(_lens(), ray, slope)


@functools.cache
def cie_absorbance() -> float:
    """σ d of the glass of CIE 171's case, by Gauss and Newton: least squares of the nine printed transmittances."""
    printed, angles, x = np.array(CIE_PRINTED, float), range(0, 90, 10), 0.04
    for _ in range(8):
        at = [
            np.array([plates(n=CIE_INDEX, incidence=angle, absorbance=x + h) for angle in angles], float)
            for h in (0, 1e-5, -1e-5)
        ]
        slope = (at[1] - at[2]) / 2e-5
        x += float(slope @ (printed - at[0]) / (slope @ slope))
    return round(x, 8)


# Rays ------------------------------------------------------------------------------------------------------------


def prism(numbers: Sequence[StandardNumber]) -> optical_systems.System:
    """A prism with a ray for each number of its kind, at the incidence of the least deviation."""
    apex = _radians([number.given["apex"] for number in numbers])
    index = np.array([_index(number) for number in numbers])
    return optical_systems.prism(apex, closed_forms.least_deviated(apex, index), index=index)


def _index(number: StandardNumber) -> Any:
    if "n" in number.given:
        return np.longdouble(number.given["n"])
    return sellmeier(GLASSES[number.medium.partition(":")[2]][0], number.given["nm"])


def drop(numbers: Sequence[StandardNumber]) -> optical_systems.System:
    """A drop with a ray for each rainbow of one order, at the incidence at which the deflection is stationary."""
    index, order = np.array([number.given["n"] for number in numbers], np.longdouble), numbers[0].given["order"]
    return optical_systems.drop(round(order), closed_forms.rainbow_incidence(index, order), index)


def deviated(a: Any, b: Any) -> Any:
    """The angles between directions (N × 3) in the plane x = 0, clockwise, in degrees."""
    return _degrees(np.arctan2(a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1], a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]))


def from_antisolar(a: Any, b: Any) -> Any:
    """The angles from the point opposite to the sun, which shines along a, of light that left along b; in degrees."""
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
        yield StandardNumber(
            f"slab, n = 1.52, {angle:g}°", "transmittance", plates, {"n": 1.52, "incidence": angle}, one, PILE
        )
    for angle in (0.0, 45.0):
        given = {"n": 1.52, "incidence": angle, "count": 2}
        yield StandardNumber(f"2 slabs, n = 1.52, {angle:g}°", "transmittance", plates, given, pile, PILE)
    for count, angle in ((1, 30.0), (1, 45.0), (1, 60.0), (4, 0.0)):
        law = functools.partial(plates, together=True)
        given = {"n": 1.52, "incidence": angle, "count": count}
        slabs = "slab" if count == 1 else f"{count} slabs"
        name, text = (
            f"{slabs} without polarisation, n = 1.52, {angle:g}°",
            f"{pile.split(',')[0]}, R the mean of s and p",
        )
        yield StandardNumber(name, "transmittance, unpolarised", law, given, text, PILE)
    for angle, printed in zip(range(0, 90, 10), CIE_PRINTED, strict=True):
        given = {"n": CIE_INDEX, "incidence": float(angle), "absorbance": cie_absorbance()}
        fit = "σ d, by least squares to the nine printed values; the index is given"
        text = "(1 − R)² a/(1 − R² a²), a = exp(−σ d/cosθ_t), mean of s and p"
        yield StandardNumber(
            f"CIE 171 clear glass, {angle}°", "transmittance", plates, given, text, CIE, printed=printed, fitted=fit
        )
    for n in (1.5, 1.5168, 1.52):
        text = "2 asin(n sin(A/2)) − A"
        yield StandardNumber(
            f"prism of 60°, n = {n:g}", "deviation", deviation, {"n": n, "apex": APEX}, text, PRISM, unit="°"
        )
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
        yield StandardNumber(
            f"Brewster's angle, {where}", "Brewster's angle", brewster, {"n": n}, "atan n", source, unit="°"
        )
    for n in (1.5, 1.3333):
        source = "Born and Wolf, Principles of Optics, 1.5.4"
        yield StandardNumber(
            f"critical angle, n = {n:g} to air", "critical angle", critical, {"n": n}, "asin 1/n", source, unit="°"
        )
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
                yield StandardNumber(
                    f"diffuse {what}, n = {n:g}, from {side}", "diffuse", diffuse, given, text, DIFFUSE
                )
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
    """The table as plain data: see the module."""
    return [number.as_dict() for number in NUMBERS.values()]
