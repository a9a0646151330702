"""Segmentation protocols: one TOML file each."""
