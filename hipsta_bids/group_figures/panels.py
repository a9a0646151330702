"""What the figures of the group level share."""

import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.drawing import new_figure
from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.fitted import FittedMaps
from hipsta_bids.group_data import Cohort, Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Colors of groups that people who cannot tell red from green can tell (Okabe and Ito 2008).
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
#: Points; of titles, of axes, and of what stands inside.
TITLE, LABEL, SMALL = 9, 7.5, 6.5
_DOTS_PER_INCH = 150


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """One figure, encoded."""

    name: str
    """File name without its extension."""
    png: bytes
    svg: bytes


def encode(name: str, figure: "Figure") -> Drawing:
    """Encode a figure as a picture and as a drawing; the same results give the same bytes."""
    from matplotlib import rc_context  # noqa: PLC0415  (optional, slow to load)

    encoded = {}
    with rc_context({"svg.hashsalt": "hipsta_bids", "svg.fonttype": "none"}):
        for kind, metadata in (("png", {"Software": None}), ("svg", {"Date": None})):
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, dpi=_DOTS_PER_INCH, metadata=metadata)
            encoded[kind] = buffer.getvalue()
    return Drawing(name=name, png=encoded["png"], svg=encoded["svg"])


def panels(n_rows: int, n_columns: int, size: tuple[float, float]) -> tuple["Figure", Any]:
    """Return an empty figure and its panels, of a size in inches."""
    figure = new_figure((size[0] * n_columns + 0.8, size[1] * n_rows + 0.4), layout="constrained")
    return figure, figure.subplots(n_rows, n_columns, squeeze=False)


def side_name(hemi: str) -> str:
    """Spell a hemisphere out."""
    return {"L": "left", "R": "right"}.get(hemi, "left minus right")


def spelled(measure: str) -> str:
    """Spell a measure with spaces."""
    return measure.replace("_", " ")


def shown(analysis: Analysis, measure: str) -> Mapping[str, FittedMaps]:
    """Give hemispheres, or their difference, that have maps of a measure."""
    return {hemi: one for hemi, one in analysis.fitted.items() if measure in one.fits}


def rows_of(analysis: Analysis, one: FittedMaps) -> pd.DataFrame:
    """Rows of the model's table that the sheets used belong to."""
    return analysis.compared.table.iloc[one.maps.rows[one.used]]


def members_of(analysis: Analysis, table: pd.DataFrame) -> Mapping[str, NDArray[np.bool_]]:
    """Tell which rows belong to each group."""
    if analysis.groups is None:
        return {"all": np.ones(len(table), dtype=bool)}
    names = table[analysis.groups.column]
    return {level: (names == level).to_numpy() for level in analysis.groups.levels}


def mean_of_known(values: Float, axis: int) -> Float:
    """Mean without what is missing; NaN where nothing is known."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def repeat_colors() -> Iterator[str]:
    """Colors of groups, again and again."""
    while True:
        yield from COLORS


def mark_medial(axis: "Axes", cohort: Cohort) -> None:
    """Say on the x axis which end is medial."""
    axis.set_xticks([cohort.x[0], cohort.x[-1]], ["medial", "lateral"], fontsize=LABEL)
    left, right = axis.get_xticklabels()
    left.set_horizontalalignment("left")
    right.set_horizontalalignment("right")
