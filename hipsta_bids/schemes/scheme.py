"""Segmentation protocols as data."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.errors import SchemeError
from hipsta_bids.schemes.tissues import MEDIAL_TO_LATERAL, Part, Tissue


@dataclass(frozen=True, kw_only=True)
class Label:
    """One code of a protocol."""

    code: int
    tissue: Tissue
    part: Part
    name: str
    abbreviation: str
    color: str
    """``#rrggbb``, for pictures and label GIFTIs."""


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """A segmentation protocol.

    ``name`` is alphanumeric: it becomes the ``seg-`` entity of output names.
    """

    name: str
    title: str
    citation: str
    sheet: tuple[Tissue, ...]
    """Tissues merged into the sheet, medial to lateral."""
    layer: tuple[Tissue, ...]
    """Tissues whose voxels go to the nearest sheet tissue."""
    interior: tuple[Tissue, ...]
    """Tissues on the concave (interior) side of the sheet."""
    labels: tuple[Label, ...]
