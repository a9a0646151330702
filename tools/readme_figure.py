"""Draw the README's figure: labels, sheet, thickness map and a group difference, all synthetic.

.venv/bin/python tools/readme_figure.py
"""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import nibabel as nib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

import hipsta_bids as hb
from hipsta_bids.api.maps import Measurement
from hipsta_bids.protocols.load import load_protocol

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "readme.png"
PROTOCOL = "freesurfer"
STEP = 0.15  # mm between the points where the slice is read
LIMITS = (1.2, 2.4)  # mm, ends of the colors
REACH = (9.0, 7.0)  # mm, half the width and height of the slice
TITLES = ("1  labels in columns", "2  sheet", "3  thickness map", "4  group difference")


def draw_slice(axis: Axes, image: Any, maps: Measurement) -> None:  # noqa: ANN401  (nibabel's)
    """Draw labels in the middle of the body, and on them the columns that are measured."""
    codes, affine = np.asarray(image.dataobj), image.affine
    colors = {label.code: label.color for label in load_protocol(PROTOCOL).labels}
    present = np.unique(codes)
    shown = ListedColormap([colors.get(int(code), "white") for code in present])
    sheet = maps.hemisphere.sheet.points
    row = sheet[:, sheet.shape[1] // 2]
    center = row.mean(axis=(0, 1))
    # The row lies across the body, whatever way that runs: the slice is cut along it.
    normal = np.linalg.svd((row - center).reshape(-1, 3), full_matrices=False)[2][2]
    right = np.cross(normal, [0, 0, 1])
    right *= np.sign(right[0]) / np.linalg.norm(right)
    up = np.cross(right, normal)
    across = np.array([right, up * np.sign(up[2])])
    x, z = (np.arange(-reach, reach, STEP) for reach in REACH)
    place = center + x[:, None, None] * across[0] + z[None, :, None] * across[1]
    index = np.rint(nib.affines.apply_affine(np.linalg.inv(affine), place)).astype(int)
    cut = codes[tuple(np.moveaxis(np.clip(index, 0, np.array(codes.shape) - 1), -1, 0))]
    ranks = np.searchsorted(present, cut)
    mesh = axis.pcolormesh(x, z, ranks.T, cmap=shown, alpha=0.5, shading="nearest")
    mesh.set_clim(-0.5, len(present) - 0.5)
    flat = (row - center) @ across.T
    axis.add_collection(LineCollection(list(flat), colors="black", linewidths=0.7))
    for wall in (0, -1):
        axis.plot(*flat[:, wall].T, color="black", linewidth=1.6)
    axis.set_aspect("equal")
    axis.set_axis_off()
    axis.plot([-REACH[0], -REACH[0] + 5], [-REACH[1] + 1] * 2, color="black")
    axis.text(-REACH[0] + 2.5, -REACH[1] + 1.3, "5 mm", ha="center", va="bottom")


def main() -> None:
    """Measure the example study, draw, save."""
    mpl.rcParams.update({"font.size": 9})
    study = hb.example()
    left = hb.measure(study.labels, side="L", protocol=PROTOCOL)
    maps, _ = hb.load(study.out_dir)
    aligned = hb.register(maps[["thickness", "curvature", "subfield"]])
    fit = hb.group(aligned.thickness, study.participants, "group + age")
    print(fit)  # noqa: T201
    figure = Figure(figsize=(11, 3))
    draw_slice(figure.add_axes((0.01, 0.06, 0.2, 0.76)), study.labels, left)
    axis: Any = figure.add_axes((0.215, -0.02, 0.24, 0.9), projection="3d")
    hb.plot_surface(left, "thickness", ax=axis, limits=LIMITS, colorbar=False, view=(40, -40))
    sizes = [np.ptp(limits) for limits in (axis.get_xlim(), axis.get_ylim(), axis.get_zlim())]
    axis.set_box_aspect(sizes, zoom=1.25)
    axis = figure.add_axes((0.495, 0.15, 0.18, 0.7))
    hb.plot_sheet(left, "thickness", ax=axis, limits=LIMITS)
    axis.set_title("")
    axis = figure.add_axes((0.765, 0.15, 0.18, 0.7))
    hb.plot_group(fit, "CN-AD", ax=axis, subfield=left.subfield)
    n_columns, n_rows = left.maps["thickness"].shape
    height, width = left.summary["extent_y"] / n_rows, left.summary["extent_x"] / n_columns
    axis.set(title="", aspect=height / width, yticks=range(0, n_rows, 5))
    for place, title in zip((0.11, 0.335, 0.585, 0.855), TITLES, strict=True):
        figure.text(place, 0.94, title, ha="center", va="center", weight="bold", size=11)
    figure.savefig(PICTURE, dpi=100)


if __name__ == "__main__":
    main()
