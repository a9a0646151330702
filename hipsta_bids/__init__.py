"""Hippocampal thickness, curvature and shape maps from subfield segmentations."""

__version__ = "0.1.0"
