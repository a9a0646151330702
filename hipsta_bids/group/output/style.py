"""Figures as a paper prints them: sizes, type, files, and what all panels have in common."""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.reports.maps import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

#: Widths of figures in mm, of one column of a journal's page and of two.
ONE_COLUMN, TWO_COLUMNS = 85.0, 180.0
DOTS_PER_INCH = 300
MM, POINT = DOTS_PER_INCH / 25.4, DOTS_PER_INCH / 72  # pixels
#: Sizes of type in points: of letters of panels, of titles, and of all else.
LETTER, TITLE, SMALL = 9.0, 8.0, 7.0
LINE = 3.2  # mm, of small type
LETTER_WIDTH = 0.6  # over the size of type
SIGNIFICANT_LINE = 1.3  # points, round what survives
ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"

_STYLE: Any = {
    "font.family": "sans-serif",
    # The first is everywhere; the other fonts are for readers of drawings who lack them.
    # Chinese, Japanese and Korean characters come from the first of these that is installed.
    "font.sans-serif": [
        "DejaVu Sans",
        "Verdana",
        "Arial",
        "Helvetica",
        "Noto Sans CJK SC",
        "Source Han Sans SC",
        "Microsoft YaHei",
        "PingFang SC",
        "Malgun Gothic",
    ],
    "font.size": SMALL,
    "axes.titlesize": TITLE,
    "axes.titley": 1.0,  # no search for a place: nothing is above the panels
    "axes.labelsize": SMALL,
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "legend.fontsize": SMALL,
    "legend.title_fontsize": SMALL,
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "image.composite_image": False,  # views in one picture with what lies between take longer
    "text.parse_math": False,  # names of groups are no formulas
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "hipsta_bids",
}
#: What of a file would change from day to day, or with the version of a library.
_METADATA: Mapping[str, Any] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
}
#: Formats of figures, by their extensions.
KINDS = tuple(_METADATA)
_INCH = 25.4  # mm
LETTERS = "abcdefghijklmnopqrstuvwxyz"

Drawing = Callable[[], "list[Figure]"]


@contextmanager
def style() -> Iterator[None]:
    """Have matplotlib draw as all figures are."""
    new_figure((1.0, 1.0), None)  # loads the library with separate settings
    from matplotlib import rc_context  # noqa: PLC0415  (slow to load)

    with rc_context(_STYLE):
        yield


def encode(
    name: str, draw: Drawing, kinds: Sequence[str] = KINDS, dpi: float = DOTS_PER_INCH
) -> list[tuple[str, bytes]]:
    """Draw figures and encode each as PDF, PNG or SVG; the same results give the same bytes."""
    encoded = []
    with style():
        for number, figure in enumerate(draw(), start=1):
            title = name if number == 1 else f"{name}_{number}"
            for kind in kinds:
                buffer = io.BytesIO()
                options: Any = {"pil_kwargs": {"compress_level": 4}} if kind == "png" else {}
                figure.savefig(buffer, format=kind, dpi=dpi, metadata=_METADATA[kind], **options)
                encoded.append((f"{title}.{kind}", buffer.getvalue()))
                figure.set_layout_engine(None)  # that of the first is for all: it takes long
    return encoded


def new_panels(
    n_rows: int, n_columns: int, size: tuple[float, float], ratios: Sequence[float] | None = None
) -> tuple["Figure", Any]:
    """Return an empty figure of a size in mm, and its panels, perhaps of several heights."""
    figure = new_figure((size[0] / _INCH, size[1] / _INCH), "constrained")
    return figure, figure.subplots(n_rows, n_columns, squeeze=False, height_ratios=ratios)


def explain(figure: "Figure", axis: "Axes", title: str | None = None) -> None:
    """Put the legend of a panel below all, where it covers no curve."""
    handles = dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True))
    letters = figure.get_figwidth() * 72 / (LETTER_WIDTH * SMALL)
    longest = max(map(len, handles)) + 8  # with the line and what is between
    columns = max(1, min(len(handles), int(letters / longest)))
    legend = figure.legend(handles.values(), handles, loc="outside lower center", ncols=columns)
    legend.set_title(title or "")


def share_limits(axes: "Sequence[Axes]") -> None:
    """Give panels the same vertical range, which has all of theirs."""
    limits = np.array([axis.get_ylim() for axis in axes])
    for axis in axes:
        axis.set_ylim(limits[:, 0].min(), limits[:, 1].max())


def letter_panels(axes: "Sequence[Axes]") -> None:
    """Put letters on panels, next to their titles."""
    for axis, letter in zip(axes, cycle(LETTERS), strict=False):
        axis.set_title(letter, loc="left", fontsize=LETTER, weight="bold")


def width_of(text: "Text") -> float:
    """Return the pixels that a text takes, measured without a page to draw on."""
    from matplotlib.backends.backend_agg import RendererAgg  # noqa: PLC0415  (slow to load)

    page: Any = RendererAgg  # it has no types
    return float(text.get_window_extent(page(1, 1, text.figure.dpi)).width)


def fit_text(text: "Text", room: float) -> None:
    """Shorten a text that takes more than some pixels."""
    words = text.get_text()
    while (width := width_of(text)) > room and len(words) > 1:
        share = room / width
        words = words[: min(len(words) - 1, int(share * len(words)))].rstrip(ELLIPSIS)
        text.set_text(words.rstrip() + ELLIPSIS)


def place_picture(
    figure: "Figure", picture: NDArray[np.uint8], place: tuple[int, int, int, int]
) -> None:
    """Put a picture at a place from the upper left corner: left, top, width and height, pixels."""
    from matplotlib.image import BboxImage  # noqa: PLC0415  (slow to load)
    from matplotlib.transforms import Bbox, TransformedBbox  # noqa: PLC0415

    whole, (left, top, width, height) = figure.bbox, place
    box = Bbox.from_bounds(
        left / whole.width,
        1 - (top + height) / whole.height,
        width / whole.width,
        height / whole.height,
    )
    image = BboxImage(
        TransformedBbox(box, figure.transFigure), origin="upper", interpolation="nearest"
    )
    image.set_data(picture)
    figure.add_artist(image)
