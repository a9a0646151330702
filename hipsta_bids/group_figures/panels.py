"""What the figures of the group level share."""

import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hipsta_bids.drawing import new_figure
from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.fitted import FittedMaps
from hipsta_bids.group_data import Cohort

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
