"""Switching Mitsuba's variant where it is another one: a switch to a compiled variant takes a tenth of a second."""

import mitsuba as mi


def switch(variant):
    """Set the variant. Nothing puts it back: every test begins with its own (see `variant` in conftest.py)."""
    if mi.variant() != variant:
        mi.set_variant(variant)
