"""Files, images, processes and TOML tables."""
