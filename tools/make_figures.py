"""Draw the README's picture: thickness and curvature on the sheets of one subject.

Run it on an output dataset, for example after ``make demo``::

    .venv/bin/python tools/make_figures.py demo/out docs/images/demo-sheet.png
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from hipsta_bids.reports.display import MAP_KINDS, X_ENDS, Y_ENDS, scale_of

HEMISPHERES = {"L": "left hemisphere", "R": "right hemisphere"}


@dataclass(frozen=True, kw_only=True)
class SheetMaps:
    """What the picture needs of one hemisphere."""

    table: pd.DataFrame
    """The sheet table, sorted by x, then y."""
    shape: tuple[int, int]
    """Nodes along x and y."""
    extent: tuple[float, float]
    """mm along x and y."""

    def values(self, column: str) -> NDArray[Any]:
        """One column as an (Nx, Ny) array."""
        return np.asarray(self.table[column]).reshape(self.shape)


def read_maps(out_dir: Path, subject: str) -> dict[str, SheetMaps]:
    """Read the tables of both hemispheres of one subject.

    Parameters
    ----------
    out_dir : Path
        An output dataset.
    subject : str
        Label without ``sub-``.

    Returns
    -------
    dict of str to SheetMaps
        By hemisphere, ``L`` and ``R``.

    Raises
    ------
    SystemExit
        If a table is missing, or there is more than one.
    """
    maps = {}
    for hemi in HEMISPHERES:
        pattern = f"sub-{subject}/**/anat/*_hemi-{hemi}_*_desc-sheet_morph.tsv"
        found = sorted(out_dir.glob(pattern))
        if len(found) != 1:
            raise SystemExit(f"{out_dir}: {len(found)} files match {pattern}; one is needed")
        table = pd.read_csv(found[0], sep="\t", na_values="n/a").sort_values(["x", "y"])
        summary_path = found[0].with_name(found[0].name.replace("desc-sheet", "desc-summary"))
        summary = pd.read_csv(summary_path, sep="\t", na_values="n/a").iloc[0]
        maps[hemi] = SheetMaps(
            table=table,
            shape=(int(table["x"].max()), int(table["y"].max())),
            extent=(float(summary["extent_x"]), float(summary["extent_y"])),
        )
    return maps


def draw(maps: dict[str, SheetMaps], title: str) -> Figure:
    """Draw one row per quantity and one column per hemisphere, each row on one color scale.

    Parameters
    ----------
    maps : dict of str to SheetMaps
        By hemisphere.
    title : str
        Above the picture.

    Returns
    -------
    Figure
        Not shown, not saved.
    """
    mpl.rcParams.update({"font.size": 11, "axes.titlesize": 12})
    figure = Figure(figsize=(9.6, 7.2), layout="compressed")
    axes = figure.subplots(len(MAP_KINDS), len(maps), squeeze=False)
    figure.suptitle(title)
    for row, kind in zip(axes, MAP_KINDS, strict=True):
        low, high = scale_of(kind, [m.values(kind.column).astype(float) for m in maps.values()])
        for axis, sheet in zip(row, maps.values(), strict=True):
            x, y = (np.linspace(0, mm, n) for mm, n in zip(sheet.extent, sheet.shape, strict=True))
            values = sheet.values(kind.column).astype(float).T
            image = axis.pcolormesh(
                x, y, values, cmap=kind.colors, vmin=low, vmax=high, shading="nearest"
            )
            _draw_subfields(axis, sheet, x, y)
            _scale_axis(axis)
        row[0].set_ylabel("  ←  mm  →  ".join(Y_ENDS))
        figure.colorbar(image, ax=list(row), label=f"{kind.title} [{kind.unit}]", shrink=0.9)
    for top, bottom, hemi in zip(axes[0], axes[-1], maps, strict=True):
        top.set_title(HEMISPHERES[hemi])
        bottom.set_xlabel("  ←  mm  →  ".join(X_ENDS))
    return figure


def _draw_subfields(
    axis: Axes, sheet: SheetMaps, x: NDArray[np.float64], y: NDArray[np.float64]
) -> None:
    """Draw the borders between subfields along cell edges, and their names."""
    names = sheet.values("subfield").astype(str)
    x_edges, y_edges = (_edges(nodes) for nodes in (x, y))
    across = np.argwhere(names[1:] != names[:-1])
    along = np.argwhere(names[:, 1:] != names[:, :-1])
    lines = [
        *(((x_edges[i + 1], y_edges[j]), (x_edges[i + 1], y_edges[j + 1])) for i, j in across),
        *(((x_edges[i], y_edges[j + 1]), (x_edges[i + 1], y_edges[j + 1])) for i, j in along),
    ]
    axis.add_collection(LineCollection(lines, colors="white", linewidths=2.6))
    axis.add_collection(LineCollection(lines, colors="black", linewidths=1.2))
    for name in np.unique(names[names != "nan"]):
        i, j = np.nonzero(names == name)
        axis.text(
            x[i].mean(),
            y[j].mean(),
            name,
            ha="center",
            va="center",
            rotation=90,
            bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.5},
        )


def _edges(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Place cell edges halfway between nodes."""
    step = nodes[1] - nodes[0]
    return np.append(nodes - step / 2, nodes[-1] + step / 2)


def _scale_axis(axis: Axes) -> None:
    """Set up one panel."""
    axis.set_aspect("equal")
    axis.set_facecolor("0.8")
    for direction in (axis.xaxis, axis.yaxis):
        direction.set_major_locator(MultipleLocator(5))


def main() -> None:
    """Read the command line, draw, save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("out_dir", type=Path, help="an output dataset")
    parser.add_argument("picture", type=Path, help="the PNG file to write")
    parser.add_argument("--subject", default="demo1", help="label without sub- (default: demo1)")
    parser.add_argument("--title", default="Synthetic hippocampal bodies (make demo)")
    options = parser.parse_args()
    figure = draw(read_maps(options.out_dir, options.subject), options.title)
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.picture, dpi=110)


if __name__ == "__main__":
    main()
