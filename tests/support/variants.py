"""Switching of Mitsuba's variant, only if it changes: a switch to a compiled variant takes a tenth of a second."""

import mitsuba as mi


def switch(variant):
    """Set the variant. It is not restored: every test sets its own first (see `variant` in conftest.py)."""
    if mi.variant() != variant:
        mi.set_variant(variant)
