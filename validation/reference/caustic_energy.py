"""The power that a lamp on the axis of a convex body of glass sends through the body to a disk below, on the same axis.

Everything is symmetric about the axis, so rays stay in a plane (x, z) through it. A ray that hits the body splits into
a reflected part outside and a refracted part inside. At each further boundary one part leaves and one part stays
inside. Light that has left does not come back, because the body is convex. So the power through a disk of radius r is

    Φ(r) = 2π I ∫ sin θ Σ_m w_m(θ) [|x_m(θ)| ≤ r] dθ          lamp at a point, intensity I = 1 W/sr
    Φ(r) = 2π E ∫ x Σ_m w_m(x) [|x_m(x)| ≤ r] dx              parallel light, irradiance E = 1 W/m²

where w_m is the product of the powers at m boundaries and x_m is where this part hits the floor. The integral is a sum
over midpoints, with an error of less than one term at each of its jumps. Fresnel's powers are those of unpolarised
light at every boundary, as in renderers without polarisation, or tracked for either wave.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STEPS = 200_000


class Ball(NamedTuple):
    """A sphere around (0, z)."""

    z: float
    radius: float

    def span(self, p: Array, d: Array) -> tuple[Array, Array]:
        """Return the distances at which rays from `p` along `d` (N × 2) enter and leave; ∞ as entry without a hit."""
        q = p - [0, self.z]
        middle, root = -(q * d).sum(1), self.radius**2 - (q[:, 0] * d[:, 1] - q[:, 1] * d[:, 0]) ** 2
        half = np.sqrt(np.maximum(root, 0))
        return np.where(root > 0, middle - half, np.inf), middle + half

    def normal(self, p: Array) -> Array:
        """Return the outward normals at points on the sphere."""
        q = p - [0, self.z]
        return np.asarray(q / np.hypot(*q.T)[:, None])  # q/radius would let the lengths of directions drift


class Above(NamedTuple):
    """The half-space above the height z."""

    z: float

    def span(self, p: Array, d: Array) -> tuple[Array, Array]:
        """As `Ball.span`."""
        with np.errstate(divide="ignore"):
            t = (self.z - p[:, 1]) / d[:, 1]
        return np.where(d[:, 1] > 0, t, -np.inf), np.where(d[:, 1] > 0, np.inf, t)

    def normal(self, p: Array) -> Array:
        """Return the outward normals."""
        return np.broadcast_to([0.0, -1.0], p.shape)


@dataclass(frozen=True)
class Setup:
    """A body of index `eta` in air, the intersection of `parts`, above the floor z = 0.

    `lamp`: height of a point lamp; None: parallel light from above. `widest`: the angle from the axis, or for parallel
    light the distance, beyond which no ray hits the body.
    """

    parts: tuple[Ball | Above, ...]
    lamp: float | None
    widest: float
    eta: float = 1.5


class Part(NamedTuple):
    """The light of N rays that leaves after a number of boundaries: position on the floor, shares of the s, p waves."""

    x: Array  # N
    shares: Array  # 2 × N


def flux(setup: Setup, radius: float, most: int = 2, steps: int = STEPS) -> tuple[float, float]:
    """Return Φ of a disk of this radius in W, for paths of up to `most` boundaries, and a bound on its error.

    The bound is four times the largest term of each part: a part may have two jumps at either end.
    """
    step = float(setup.widest) / steps
    midpoints = np.asarray(step * (np.arange(steps) + 0.5), np.float64)
    ring = 2 * np.pi * step * (midpoints if setup.lamp is None else np.sin(midpoints))
    terms = [(ring * shares.mean(0))[np.abs(x) <= radius] for x, shares in parts(setup, midpoints, most)]
    return float(sum(x.sum() for x in terms)), float(sum(4 * x.max(initial=0) for x in terms))


def parts(setup: Setup, at: Array, most: int, polarised: bool = False) -> Iterator[Part]:
    """Yield the `Part` after 1, 2, … `most` boundaries, of rays at the angles or distances `at` (N)."""
    zero = np.zeros_like(at)
    if setup.lamp is None:
        p, d = np.stack([at, zero + 1e3], 1), np.stack([zero, zero - 1], 1)
    else:
        p, d = np.stack([zero, zero + setup.lamp], 1), np.stack([np.sin(at), -np.cos(at)], 1)
    shares = np.ones((2, len(at)))
    for number in range(1, most + 1):
        entering = number == 1
        starts, ends = np.array([part.span(p, d) for part in setup.parts]).swapaxes(0, 1)
        distance, which = (starts.max(0), starts.argmax(0)) if entering else (ends.min(0), ends.argmin(0))
        hit = np.isfinite(distance) & ((starts.max(0) < ends.min(0)) | (not entering))
        p = p + np.where(hit, distance, 0)[:, None] * d
        normals = np.array([part.normal(p) for part in setup.parts])[which, np.arange(len(p))]
        mirrored, refracted, powers = boundary(d, normals, 1 / setup.eta if entering else setup.eta)
        reflected = powers if polarised else np.broadcast_to(powers.mean(0), powers.shape)
        leaving, inside = (mirrored, refracted) if entering else (refracted, mirrored)
        out_share, in_share = (reflected, 1 - reflected) if entering else (1 - reflected, reflected)
        yield Part(_floor(p, leaving), np.where(hit, shares * out_share, 0))
        shares, d = np.where(hit, shares * in_share, 0), inside


def boundary(d: Array, normal: Array, k: float) -> tuple[Array, Array, Array]:
    """Return reflected and refracted directions (N × 2) and the reflected powers of the s and p waves (2 × N).

    k: index before over index behind. For total reflection the powers are 1 and the refracted direction has no meaning.
    """
    c = (d * normal).sum(1, keepdims=True)
    inner = 1 - k * k * (1 - c * c)
    cos_t, cos_i = np.sqrt(np.maximum(inner, 0)), np.abs(c)
    refracted = k * (d - c * normal) + np.copysign(cos_t, c) * normal
    r = np.stack([(k * cos_i - cos_t) / (k * cos_i + cos_t), (cos_i - k * cos_t) / (cos_i + k * cos_t)])
    return d - 2 * c * normal, refracted, np.where(inner > 0, r * r, 1)[..., 0]


def _floor(p: Array, d: Array) -> Array:
    """Return where rays hit z = 0; infinity for rays that go up."""
    down = d[:, 1] < 0
    return np.where(down, p[:, 0] - d[:, 0] * p[:, 1] / np.where(down, d[:, 1], -1), np.inf)


# Disks below a ball and a lens ---------------------------------------------------------------------------------

POINT, SPOT, PARALLEL = "point", "spot", "directional"
LENS_RADIUS, LENS_APERTURE = 1.0, 0.6
TOP, BALL_HEIGHT, LENS_HEIGHT = 4.5, 2.5, 2.7  # heights of lamps, of the ball's centre, of the lens's flat side
_BALL = (Ball(BALL_HEIGHT, 1.0),)
_LENS = (Ball(LENS_HEIGHT - math.sqrt(LENS_RADIUS**2 - LENS_APERTURE**2), LENS_RADIUS), Above(LENS_HEIGHT))
_WIDEST = {"ball": math.asin(1 / (TOP - BALL_HEIGHT)), "lens": math.atan(LENS_APERTURE / (TOP - LENS_HEIGHT))}
ON_AXIS = {  # by body and lamp: the setup of the quadrature, and the radius of a disk around the caustic, in the shadow
    **{("ball", lamp): (Setup(_BALL, TOP, _WIDEST["ball"]), 1.5) for lamp in (POINT, SPOT)},
    ("ball", PARALLEL): (Setup(_BALL, None, 1.0), 0.9),
    **{("lens", lamp): (Setup(_LENS, TOP, _WIDEST["lens"]), 1.2) for lamp in (POINT, SPOT)},
    ("lens", PARALLEL): (Setup(_LENS, None, LENS_APERTURE), 0.5),
}
REFLECTANCE = 0.02  # of the disk: the glass returns little of the disk's own light to it
_ELEVATION, FIELD = math.radians(30), 10.0  # of a camera that looks at the centre of the disk, in radians and degrees
VIEWPOINT = 20 * np.array([0, math.sin(_ELEVATION), math.cos(_ELEVATION)])  # y is up


def ball_profile(rings: int) -> Array:
    """Return the ball's profile from top to bottom: distance from the axis, height (rings + 1 × 2)."""
    angle = np.linspace(0, np.pi, rings + 1)
    return np.stack([np.sin(angle), BALL_HEIGHT + np.cos(angle)], 1)


def lens_profile(rings: int, bottom: float = LENS_HEIGHT, scale: float = 1.0) -> Array:
    """Return the profile of the plano-convex lens, as `ball_profile`: flat side at `bottom`, size times `scale`."""
    angle = np.linspace(0, math.asin(LENS_APERTURE / LENS_RADIUS), rings + 1)
    centre = bottom - scale * math.sqrt(LENS_RADIUS**2 - LENS_APERTURE**2)
    cap = np.stack([scale * LENS_RADIUS * np.sin(angle), centre + scale * LENS_RADIUS * np.cos(angle)], 1)
    return np.concatenate([cap, [[0, bottom]]])


def power_by_radiance(resolution: int) -> Array:
    """Return for each pixel of a square image from VIEWPOINT the power on the disk over its radiance, in m² sr.

    A pixel is a square of side a at distance 1; rays through it, d = x + y + forward, hit the floor at t d, in an area
    of a² t²/|d_y|.
    """
    half = math.tan(math.radians(FIELD / 2))
    y = half * (1 - (np.arange(resolution) + 0.5) / resolution * 2)
    d_y = y[:, None] * math.cos(_ELEVATION) - math.sin(_ELEVATION)
    return np.asarray(np.pi / REFLECTANCE * np.square(2 * half / resolution * VIEWPOINT[1] / d_y) / np.abs(d_y))
