"""Segmentation protocols: one TOML file each, and the loader that validates them."""

from hipsta_bids.schemes.loader import load_scheme, scheme_names, scheme_table
from hipsta_bids.schemes.names import NamedCode, agrees, identify_tissue, scheme_from_names
from hipsta_bids.schemes.regions import for_region
from hipsta_bids.schemes.scheme import Label, Scheme, translate
from hipsta_bids.schemes.tissues import FAR_TO_NEAR, MEDIAL_TO_LATERAL, Part, Tissue, lateral_rank

__all__ = [
    "FAR_TO_NEAR",
    "MEDIAL_TO_LATERAL",
    "Label",
    "NamedCode",
    "Part",
    "Scheme",
    "Tissue",
    "agrees",
    "for_region",
    "identify_tissue",
    "lateral_rank",
    "load_scheme",
    "scheme_from_names",
    "scheme_names",
    "scheme_table",
    "translate",
]
