"""Segmentation protocols: one TOML file each, and the loader that validates them."""

from hipsta_bids.schemes.loader import load_scheme, scheme_names, scheme_table
from hipsta_bids.schemes.scheme import Label, Scheme, translate
from hipsta_bids.schemes.tissues import MEDIAL_TO_LATERAL, Part, Tissue

__all__ = [
    "MEDIAL_TO_LATERAL",
    "Label",
    "Part",
    "Scheme",
    "Tissue",
    "load_scheme",
    "scheme_names",
    "scheme_table",
    "translate",
]
