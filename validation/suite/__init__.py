"""Study of other people's refraction."""
