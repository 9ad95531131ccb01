"""Certified answers by ball arithmetic."""

from .ball_arithmetic import Certified, Residual, fresnel, margin, refract, residual

__all__ = ["Certified", "Residual", "fresnel", "margin", "refract", "residual"]
