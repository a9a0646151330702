"""A cohort of sheets with head and tail, with an effect in the head alone."""

from dataclasses import replace

import numpy as np
from small_cohorts import NODES, PLAN, write_dataset

from hipsta_bids.protocols import rows_beyond

REGION = "whole"
TAIL, HEAD = rows_beyond(REGION, NODES[1])
SHAPE = (NODES[0], TAIL + NODES[1] + HEAD)
#: A difference in the head alone.
IN_HEAD = replace(
    PLAN, nodes=SHAPE, center=(12.0, TAIL + NODES[1] + 2.0), core=(1.5, 1.0), taper=1.0
)
N = sum(PLAN.sizes)
QUICK = ["--measures", "thickness", "--formula", "group", "--contrast", "group[CN]-group[AD]"]
HOLE = (slice(4, 7), slice(TAIL + 1, TAIL + 4))


def known_nodes():
    """Rims of all, wider in some; a hole in all but two of either group."""
    known = np.ones((N, *SHAPE), dtype=bool)
    known[:, [0, -1]] = False
    known[::2, :, -1] = False
    known[2 : N - 2, *HOLE] = False
    return known


def write_whole(root):
    """Write the dataset; its folder and that of the participant level."""
    return write_dataset(root, region=REGION, plan=IN_HEAD, known=known_nodes())
