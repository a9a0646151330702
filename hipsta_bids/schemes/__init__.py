"""Segmentation protocols: one TOML file each, and the loader that validates them."""

from hipsta_bids.schemes.loader import load_scheme, scheme_names, scheme_table
from hipsta_bids.schemes.names import NamedCode, agrees, identify_tissue, scheme_from_names
from hipsta_bids.schemes.scheme import Label, Scheme, translate
from hipsta_bids.schemes.tissues import MEDIAL_TO_LATERAL, Part, Tissue

__all__ = [
    "MEDIAL_TO_LATERAL",
    "Label",
    "NamedCode",
    "Part",
    "Scheme",
    "Tissue",
    "agrees",
    "identify_tissue",
    "load_scheme",
    "scheme_from_names",
    "scheme_names",
    "scheme_table",
    "translate",
]
