"""Export a Mitsuba scene as plain data to other renderers."""
