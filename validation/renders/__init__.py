"""Study of `refract` against `dielectric` in renders."""
