"""The vocabulary that every segmentation protocol is translated into."""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


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

#: Cortex that the sheet goes on into beyond its medial end, from far to near. The entorhinal cortex
#: lies before the parahippocampal cortex rather than beside it.
FAR_TO_NEAR: tuple[Tissue, ...] = (
    Tissue.BA36,
    Tissue.BA35,
    Tissue.ENTORHINAL,
    Tissue.PARAHIPPOCAMPAL,
    Tissue.PARASUBICULUM,
)

#: Rank along the sheet by tissue: that of the subfields is their value, which rises from medial to
#: lateral; cortex has 0 and less, the same where it lies side by side.
_RANKS = np.arange(max(Tissue) + 1, dtype=np.int8)
_RANKS[list(FAR_TO_NEAR)] = (-3, -2, -1, -1, 0)
_RANKS.flags.writeable = False


def lateral_rank(tissue: NDArray[np.uint8]) -> NDArray[np.int8]:
    """Rank from medial to lateral of the tissues of a sheet and of the cortex beside it.

    Parameters
    ----------
    tissue : array of uint8, any shape
        Values of :class:`Tissue`.

    Returns
    -------
    array of int8, same shape
        0 for the background.
    """
    return np.asarray(_RANKS[tissue])
