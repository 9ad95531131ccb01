"""Rays for Fresnel's equations: cosines of incidence and ratios k, near every edge."""

from __future__ import annotations

import zlib

import numpy as np

COUNT = {"scalar": 60, "llvm": 2000, "cuda": 2000}


def log_uniform(rng, low, high, count):
    return np.exp(rng.uniform(np.log(low), np.log(high), count))


def aside(rng, x, precision, most=4):
    """A few ulps, or many."""
    count = len(x)
    ulps = np.where(
        rng.random(count) < 0.6,
        rng.integers(-most, most + 1, count),
        log_uniform(rng, 1, 1e5, count) * rng.choice([-1, 1], count),
    )
    x = x.astype(precision)
    return x.astype(np.longdouble) + np.rint(ulps) * np.spacing(x).astype(np.longdouble)


def generic(rng, count, precision):
    return rng.random(count), log_uniform(rng, 0.3, 3, count)


def near_normal(rng, count, precision):
    return np.cos(log_uniform(rng, 1e-12, 0.1, count)), rng.uniform(0.4, 2.5, count)


def grazing(rng, count, precision):
    return log_uniform(rng, 1e-30, 1e-2, count), rng.uniform(0.1, 1, count)


def critical(rng, count, precision):
    k = log_uniform(rng, 1.0001, 1e6, count).astype(precision).astype(np.longdouble)
    return aside(rng, np.sqrt((k - 1) * (k + 1)) / k, precision), k


def brewster(rng, count, precision):
    k = log_uniform(rng, 1e-3, 1e3, count).astype(precision).astype(np.longdouble)
    return aside(rng, k / np.sqrt(1 + k * k), precision, most=1), k


def matched(rng, count, precision):
    cosines = np.where(rng.random(count) < 0.5, rng.random(count), log_uniform(rng, 1e-8, 1, count))
    return cosines, 1 + log_uniform(rng, np.finfo(precision).eps, 0.1, count) * rng.choice([-1, 1], count)


def steep(rng, count, precision):
    k = log_uniform(rng, 3, 1e6, count)
    return np.sqrt(np.maximum(0, 1 - (rng.uniform(0, 1.05, count) / k) ** 2)), k


def dense(rng, count, precision):
    return rng.random(count), log_uniform(rng, 1e-6, 0.3, count)


DRAWS = {f.__name__: f for f in (generic, near_normal, grazing, critical, brewster, matched, steep, dense)}
# Where hill-climbing on the bits came to rest, from the worst of 10⁶ rays in each of eleven regimes: R, R, T, r_p.
WORST = {
    "float32": [
        ("0x1.66e34ep-3", "0x1.f71f70p-1"),
        ("0x1.c81bbap-3", "0x1.fc2786p-1"),
        ("0x1.011ddap-18", "0x1.ffeff8p-1"),
        ("0x1.80031cp-7", "0x1.818ad6p-7"),
    ],
    "float64": [
        ("0x1.e898ee75f23cfp-3", "0x1.c844d6fedd815p-1"),
        ("0x1.044677cde968cp-3", "0x1.fffffffde5f77p-1"),
        ("0x1.064d256c22f3ep-25", "0x1.b7d121d98bfe6p-1"),
        ("0x1.528f43a801557p-26", "0x1.ffffffffffbfbp-1"),
    ],
}


def drawn(name, setting):
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    cos_i, k = DRAWS[name](rng, COUNT[setting.backend], setting.precision)
    return np.clip(cos_i, 0, 1).astype(setting.precision), k.astype(setting.precision)
