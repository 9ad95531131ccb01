"""The Mitsuba plugins: the BSDF `refract` and the integrator `refract_path`."""
