"""Maps of one hemisphere, or of a difference of both, and the model at each point."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError
from hipsta_bids.group.contrasts import Contrast
from hipsta_bids.group.glm import PointwiseFit
from hipsta_bids.group.row_model import RowModel
from hipsta_bids.group_data import Float, Int, SideMaps
from hipsta_bids.group_settings import GroupSettings


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedMaps:
    """What was fitted, and the fit."""

    maps: SideMaps
    """Of all rows of the model's table that have them."""
    used: Int
    """Sheets that the model is fitted to, as places in ``maps``."""
    rows: Int
    """Rows of the design of the sheets used."""
    subfield: Int
    """(x, y) most frequent subfield, place in ``maps.names``; -1 where there is none."""
    fits: Mapping[str, PointwiseFit]
    """By measure."""

    def values(self, measure: str) -> Float:
        """(sheets used, points) of one measure."""
        return _values(self.maps.maps[measure], self.used)


def fit_maps(
    hemi: str,
    side: SideMaps,
    model: RowModel,
    settings: GroupSettings,
    *,
    contrasts: tuple[Contrast, ...] | None = None,
) -> FittedMaps:
    """Fit a model at each point of all maps of a hemisphere.

    Parameters
    ----------
    hemi : str
        For messages.
    side : SideMaps
        Registered maps, or differences.
    model : RowModel
        Design.
    settings : GroupSettings
        Of the model.
    contrasts : tuple of Contrast, optional
        What is tested; else the contrasts of the design.

    Raises
    ------
    ModelError
        If the model cannot be fitted, or no point has enough values.
    """
    _, used, rows = np.intersect1d(
        side.rows, model.design.rows, assume_unique=True, return_indices=True
    )
    tested = model.design.contrasts if contrasts is None else contrasts
    try:
        fits = {
            name: model.fit(_values(maps, used), rows, tested, settings)
            for name, maps in side.maps.items()
        }
    except ModelError as error:
        raise ModelError(f"hemisphere {hemi}: {error}", reason=error.reason) from error
    for name, fit in fits.items():
        if not np.isfinite(fit.sigma).any():
            raise ModelError(
                f"hemisphere {hemi}: no point of the {name} maps has enough values for the model;"
                " look at the sheets, or use a smaller model",
                reason="all-points-invalid",
            )
    return FittedMaps(
        maps=side,
        used=np.asarray(used, dtype=np.int64),
        rows=np.asarray(rows, dtype=np.int64),
        subfield=most_frequent(side.subfield[used], len(side.names)),
        fits=fits,
    )


def _values(maps: Float, used: Int) -> Float:
    own = maps if len(used) == len(maps) else maps[used]
    return own.reshape(len(used), -1)


def most_frequent(labels: NDArray[np.int8], count: int) -> Int:
    """Most frequent label at each point.

    Parameters
    ----------
    labels : ndarray of int, shape (sheets, x, y)
        -1 is missing.
    count : int
        Labels are below this.

    Returns
    -------
    ndarray of int, shape (x, y)
        -1 where there is none.
    """
    if not count:
        return np.full(labels.shape[1:], -1, dtype=np.int64)
    votes = np.stack([(labels == label).sum(axis=0) for label in range(count)])
    return np.where(votes.max(axis=0) > 0, votes.argmax(axis=0), -1).astype(np.int64)
