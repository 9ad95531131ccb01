"""Sets of rays for other people's refraction, and the check of the answers."""
