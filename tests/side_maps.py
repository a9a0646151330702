"""Maps of one hemisphere, made of arrays."""

import numpy as np
import pandas as pd

from hipsta_bids.stats.arrays import SideMaps


def side_of(rows, **maps):
    """Maps (sheets, x, y) by measure, of some rows of a table; all points are of one subfield."""
    shape = next(iter(maps.values())).shape
    subfield = np.zeros(shape, dtype=np.int8)
    summary = pd.DataFrame({"mean": np.arange(len(rows), dtype=float)})
    return SideMaps(
        rows=np.asarray(rows), maps=maps, subfield=subfield, names=("CA1",), summary=summary
    )
