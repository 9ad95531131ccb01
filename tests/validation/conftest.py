"""What several tests of the studies need."""

import dataclasses

import pytest


@pytest.fixture
def few(monkeypatch):
    """Sets of forty rays, of those that other systems are asked."""
    from validation.suite import per_ray

    smaller = {name: dataclasses.replace(kind, count=40) for name, kind in per_ray.SETS.items()}
    monkeypatch.setattr(per_ray, "SETS", smaller)
    per_ray.given.cache_clear()
    yield
    per_ray.given.cache_clear()
