"""Named, replayable families of rays."""

from .table import REGIMES, Array, Draw, Index, Rays, Regime, Triple, make, normalised, radicand, rays_at

__all__ = ["REGIMES", "Array", "Draw", "Index", "Rays", "Regime", "Triple", "make", "normalised", "radicand", "rays_at"]
