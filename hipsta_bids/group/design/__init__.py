"""Formulas, contrasts, comparisons and settings of the group level."""
