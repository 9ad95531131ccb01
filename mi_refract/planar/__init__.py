"""Rays in the plane: boundaries, tracing, scene files, figures."""

from .tracer import Event, Paths, Segments, Tracer, trace

__all__ = ["Event", "Paths", "Segments", "Tracer", "trace"]
