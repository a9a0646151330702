"""Draw the README's picture: thickness and curvature on the sheets of one subject.

Run it on an output dataset, for example after ``make demo``::

    .venv/bin/python tools/make_figures.py demo/out docs/images/demo-sheet.png
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import CenteredNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

#: Column of the sheet table, title with unit, color map, and whether its middle means zero.
QUANTITIES = (
    ("thickness", "Thickness [mm]", "viridis", False),
    ("curvature", "Mean curvature, mid-surface [1/mm]", "RdBu_r", True),
)

#: In the order in which the brain is seen from above: left first, the medial sides facing.
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
    axes = figure.subplots(len(QUANTITIES), len(maps), squeeze=False)
    figure.suptitle(title)
    for row, (column, label, colors, centered) in zip(axes, QUANTITIES, strict=True):
        norm = _scale([m.values(column) for m in maps.values()], centered=centered)
        for axis, (hemi, sheet) in zip(row, maps.items(), strict=True):
            x, y = (np.linspace(0, mm, n) for mm, n in zip(sheet.extent, sheet.shape, strict=True))
            values = sheet.values(column).astype(float).T
            image = axis.pcolormesh(x, y, values, cmap=colors, norm=norm, shading="nearest")
            _draw_subfields(axis, sheet, x, y)
            _scale_axis(axis, hemi)
        row[0].set_ylabel("posterior  ←  mm  →  anterior")
        figure.colorbar(image, ax=list(row), label=label, shrink=0.9)
    for top, bottom, hemi in zip(axes[0], axes[-1], maps, strict=True):
        top.set_title(HEMISPHERES[hemi])
        sides = ("lateral", "medial") if hemi == "L" else ("medial", "lateral")
        bottom.set_xlabel("  ←  mm  →  ".join(sides))
    return figure


def _scale(arrays: Sequence[NDArray[Any]], *, centered: bool) -> Normalize:
    """One scale for all; a few extreme points at the edges may saturate."""
    values = np.concatenate([a.astype(float).ravel() for a in arrays])
    low, high = np.nanpercentile(values, [1, 99])
    if centered:
        return CenteredNorm(vcenter=0, halfrange=float(max(abs(low), abs(high))))
    return Normalize(float(low), float(high))


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


def _scale_axis(axis: Axes, hemi: str) -> None:
    """Set up one panel; the left sheet is mirrored so that the medial sides face."""
    axis.set_aspect("equal")
    axis.set_facecolor("0.8")
    if hemi == "L":
        axis.invert_xaxis()
    for direction in (axis.xaxis, axis.yaxis):
        direction.set_major_locator(MultipleLocator(5))


def main() -> None:
    """Read the command line, draw, save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("out_dir", type=Path, help="an output dataset")
    parser.add_argument("picture", type=Path, help="the PNG file to write")
    parser.add_argument("--subject", default="01", help="label without sub- (default: 01)")
    parser.add_argument("--title", default="Synthetic hippocampal bodies (make demo)")
    options = parser.parse_args()
    figure = draw(read_maps(options.out_dir, options.subject), options.title)
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.picture, dpi=110)


if __name__ == "__main__":
    main()
