"""The vocabulary that every segmentation protocol is translated into."""

from enum import IntEnum


class Tissue(IntEnum):
    """What a voxel is. Values are internal; files of other tools never use them."""

    BACKGROUND = 0
    PRESUBICULUM = 1
    SUBICULUM = 2
    CA1 = 3
    CA2 = 4
    CA2_3 = 5  # CA2 and CA3 under one label
    CA3 = 6
    CA4 = 7
    DENTATE_GYRUS = 8  # also DG + CA4 (hilus) under one label
    MOLECULAR_LAYER = 9  # SRLM: strata radiatum, lacunosum, moleculare
    PARASUBICULUM = 10
    HATA = 11
    FIMBRIA = 12
    FISSURE = 13
    CYST = 14
    HIPPOCAMPUS = 15  # a head or tail label without subfields
    ENTORHINAL = 16
    BA35 = 17
    BA36 = 18
    PARAHIPPOCAMPAL = 19
    OTHER = 20  # named by the protocol, not used here (amygdala nuclei, ...)


class Part(IntEnum):
    """Where along the long axis a voxel lies, as far as its label says."""

    UNKNOWN = 0
    HEAD = 1
    BODY = 2
    TAIL = 3


#: Order of the sheet's subfields from medial to lateral (Diers et al. 2023, section 2.1).
MEDIAL_TO_LATERAL: tuple[Tissue, ...] = (
    Tissue.PRESUBICULUM,
    Tissue.SUBICULUM,
    Tissue.CA1,
    Tissue.CA2,
    Tissue.CA2_3,
    Tissue.CA3,
)
