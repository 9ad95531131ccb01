"""Textbook refraction in numpy, and versions with one mistake each: `f(a, n, k) -> b`."""

from __future__ import annotations

import numpy as np

from mi_refract.ray_sets.ray_set import indices


def dot(u, v):
    return (u * v).sum(1, keepdims=True)


def unit(v):
    return v / np.sqrt(dot(v, v))


def glsl(a, n, k):
    """Return GLSL's `refract`: one-sided, with the zero vector for total internal reflection."""
    k, c = k[:, None], dot(n, a)
    radicand = 1 - k * k * (1 - c * c)
    return np.where(radicand < 0, 0, k * a - (k * c + np.sqrt(np.maximum(radicand, 0))) * n).astype(a.dtype)


def two_sided(a, n, k):
    return glsl(a, np.where(dot(n, a) > 0, -n, n), k)


def mirrored(a, n, k):
    return a - 2 * dot(n, a) * n


def with_nan(a, n, k):
    b = glsl(a, n, k)
    return np.where(b.any(1, keepdims=True), b, np.nan)


def with_mirror(a, n, k):
    b = glsl(a, n, k)
    return np.where(b.any(1, keepdims=True), b, mirrored(a, n, k))


def with_tangent(a, n, k):
    """Return k times the tangent for total internal reflection, as Mitsuba's `refract` does."""
    b = glsl(a, n, k)
    return np.where(b.any(1, keepdims=True), b, k[:, None] * (a - dot(n, a) * n))


def with_normals_made_unit(a, n, k):
    return glsl(unit(a), unit(n), k)


def by_angle(change):
    """Return refraction computed with angles; `change` contains the mistake."""

    def refract(a, n, k):
        c = np.clip(-dot(n, a), -1, 1)
        tangent = a + c * n
        with np.errstate(all="ignore"):
            angle = change(np.arccos(c), k[:, None])
            b = np.sin(angle) * tangent / np.maximum(np.sqrt(dot(tangent, tangent)), 1e-30) - np.cos(angle) * n
        return np.where(np.isfinite(b), b, 0).astype(a.dtype)

    return refract


def snell(theta, k):
    return np.arcsin(k * np.sin(theta))


def swapped(v):
    return v[:, [0, 2, 1]]


def mirror_x(v):
    return v * np.array([-1, 1, 1], v.dtype)


GOOD = {"zero": glsl, "nan": with_nan, "reflected": with_mirror, "tangent": with_tangent}


def not_squared(a, n, k):
    k, c = k[:, None], dot(n, a)
    radicand = 1 - k * (1 - c * c)
    return np.where(radicand < 0, 0, k * a - (k * c + np.sqrt(np.abs(radicand))) * n)


# Programs by the name of their mistake.
BAD = {
    "eta inverted": [lambda a, n, k, f=f: f(a, n, 1 / k) for f in (glsl, with_mirror, with_nan)],
    "an index ignored": [lambda a, n, k: glsl(a, n, indices(k)[0]), lambda a, n, k: glsl(a, n, 1 / indices(k)[1])],
    "eta not squared": [not_squared],
    "normal flipped": [lambda a, n, k: glsl(a, -n, k), lambda a, n, k: with_mirror(a, -n, k)],
    "direction reversed": [
        lambda a, n, k: glsl(-a, n, k),
        lambda a, n, k: two_sided(-a, n, k),
        lambda a, n, k: two_sided(-a, n, 1 / k),
        lambda a, n, k: -glsl(a, n, k),
    ],
    "reflected instead of refracted": [mirrored],
    "degrees and radians": [
        by_angle(lambda theta, k: np.degrees(snell(theta, k))),
        by_angle(lambda theta, k: np.radians(snell(theta, k))),
        by_angle(lambda theta, k: snell(np.degrees(theta), k)),
        by_angle(lambda theta, k: snell(np.radians(theta), k)),
    ],
    "handedness": [
        lambda a, n, k: swapped(glsl(a, n, k)),
        lambda a, n, k: mirror_x(glsl(a, n, k)),
        lambda a, n, k: glsl(a, swapped(n), k),
        lambda a, n, k: two_sided(a, mirror_x(n), k),
        lambda a, n, k: two_sided(swapped(a) * np.array([1, -1, 1], a.dtype), n, k),
    ],
    "missing normalisation": [lambda a, n, k: 1.5 * glsl(a, n, k), lambda a, n, k: glsl(a, n, k) / k[:, None]],
}


def _with_root(radicand):
    """Return b = k (n × a) × n − √R n for a radicand R, a function of (a, n, k, n·a, n × a)."""

    def refract(a, n, k):
        k, w = k[:, None], np.cross(n, a)
        r = radicand(a, n, k, dot(n, a), w)
        return np.where(r < 0, 0, k * np.cross(w, n) - np.sqrt(np.maximum(r, 0)) * n).astype(a.dtype)

    return refract


def made_unit(program):
    def refract(a, n, k):
        b = program(a, n, k)
        return np.where(b.any(1, keepdims=True), unit(np.where(b.any(1, keepdims=True), b, 1)), 0).astype(a.dtype)

    return refract


def rotated(a, n, k):
    c = dot(n, a)
    tangent = a - c * n
    sine = np.sqrt(dot(tangent, tangent))
    with np.errstate(all="ignore"):
        ratio = sine / np.abs(c)
        x = k[:, None] * ratio / np.sqrt(1 + ratio * ratio)
        b = x * tangent / np.maximum(sine, np.finfo(a.dtype).tiny) - np.cos(np.arcsin(x)) * n
    return np.where(x <= 1, b, 0).astype(a.dtype)


# The documented formulas in numpy.
FORMULAS = {
    "wedge": _with_root(lambda a, n, k, c, w: dot(a, a) - k * k * dot(w, w)),
    "wedge_contrast": _with_root(lambda a, n, k, c, w: c * c - (k * k - 1) * dot(w, w)),
    "cross": _with_root(lambda a, n, k, c, w: 1 - dot(k * w, k * w)),
    "decomposed": glsl,
    "rotated": rotated,
}
