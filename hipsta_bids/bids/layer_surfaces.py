"""Reads the surfaces of many sheets."""

from collections.abc import Sequence

import numpy as np

from hipsta_bids.bids.point_files import read_mesh
from hipsta_bids.bids.results import ResultPlace
from hipsta_bids.errors import InputError
from hipsta_bids.group_data import Float

_KEYS = ("interior_surface", "midthickness_surface", "exterior_surface")


def read_layer_surfaces(
    places: Sequence[ResultPlace], shape: tuple[int, int]
) -> tuple[list[int], Float]:
    """Read interior, middle and exterior surfaces of those sheets that have all of them.

    Parameters
    ----------
    places : sequence of ResultPlace
        Hemispheres.
    shape : (int, int)
        Nodes of the sheet along x and y.

    Returns
    -------
    list of int
        Places of those read, in the sequence.
    ndarray, shape (sheets, 3, x, y, 3)
        mm, in the space of each scan.
    """
    found, layers = [], []
    for i, place in enumerate(places):
        try:
            surfaces = [read_mesh(place.path(key)).points for key in _KEYS]
        except InputError:  # maps and statistics do without it
            continue
        if all(surface.shape == (shape[0] * shape[1], 3) for surface in surfaces):
            found.append(i)
            layers.append(np.stack(surfaces).reshape(len(_KEYS), *shape, 3))
    return found, np.array(layers, dtype=np.float64).reshape(-1, len(_KEYS), *shape, 3)
