"""Draw the README's figure: from labels to a thickness map, on a real hippocampus.

The labels are drawn from HippUnfold's surfaces of the template OASIS30ANTs (MIT license,
see docs/images/readme.LICENSE.txt), which the folder given holds::

    .venv/bin/python tools/readme_figure.py TEMPLATES docs/images/readme.png
    .venv/bin/python tools/readme_figure.py TEMPLATES docs/images/regions-whole.png --region whole
"""

import argparse
from pathlib import Path
from typing import Any

import matplotlib as mpl
import nibabel as nib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

import hipsta_bids as hb
from hipsta_bids.api.maps import Measurement
from hipsta_bids.protocols.load import load_protocol

NAME = "tpl-OASIS30ANTs"
VOXEL = 0.3  # mm
STEPS = 6  # points along the edge of a triangle, and across the wall: closer than a voxel
LIMITS = (1.3, 2.4)  # mm, ends of the colors
REACH = (11.0, 8.0)  # mm, half the width and height of the slice
SIDE = "R"
TITLES = ("1   your labels, cut into columns", "2   as a sheet", "3   unfolded, to compare people")
INTERIOR = (5, 6, 7)  # CA4, dentate gyrus and SRLM

Float = NDArray[np.float64]


def _read(path: str | Path) -> Any:  # noqa: ANN401  (of many types)
    return nib.load(path)


def draw_labels(folder: Path, side: str) -> tuple[NDArray[np.int16], Float]:
    """Fill the space between corresponding triangles of two surfaces with their subfield.

    Returns codes of the protocol ``hippunfold``, and the affine from voxel index to RAS mm. What
    the sheet encloses comes from the template's own labels.
    """
    stem = folder / NAME / f"{NAME}_hemi-{side}_space-T1w"
    walls = [_read(f"{stem}_den-0p5mm_label-hipp_{wall}.surf.gii") for wall in ("inner", "outer")]
    inner, outer = (wall.agg_data("pointset").astype(np.float64) for wall in walls)
    triangles = walls[0].agg_data("triangle")
    fields = _read(folder / f"hemi-{side}_den-0p5mm_label-hipp_subfields.label.gii").agg_data()
    low = np.minimum(inner, outer).min(axis=0) - 5
    shape = np.ceil((np.maximum(inner, outer).max(axis=0) + 5 - low) / VOXEL).astype(int)
    affine = np.diag([VOXEL, VOXEL, VOXEL, 1.0])
    affine[:3, 3] = low
    image = _read(f"{stem}_desc-subfields_dseg.nii.gz")
    place = nib.affines.apply_affine(affine, np.indices(shape).reshape(3, -1).T)
    own = np.rint(nib.affines.apply_affine(np.linalg.inv(image.affine), place)).astype(int)
    held = ((own >= 0) & (own < image.shape)).all(axis=1)
    enclosed = np.zeros(len(own), dtype=np.int16)
    enclosed[held] = np.asarray(image.dataobj)[tuple(own[held].T)]
    codes = np.where(np.isin(enclosed, INTERIOR), enclosed, 0).reshape(shape).astype(np.int16)
    grid = [(i, j, STEPS - i - j) for i in range(STEPS + 1) for j in range(STEPS + 1 - i)]
    for weights in np.array(grid) / STEPS:
        for share in np.linspace(0, 1, 2 * STEPS):
            wall = (1 - share) * inner + share * outer
            points = np.einsum("k,nki->ni", weights, wall[triangles])
            codes[tuple(np.rint((points - low) / VOXEL).astype(int).T)] = fields[triangles[:, 0]]
    return codes, affine


def draw_slice(axis: Axes, codes: NDArray[np.int16], affine: Float, maps: Measurement) -> None:
    """Draw labels in the middle of the body, and on them the columns that are measured."""
    protocol = load_protocol("hippunfold")
    colors = {label.code: label.color for label in protocol.labels}
    shown = ListedColormap(["white", *(colors[code] for code in range(1, 9))])
    sheet = maps.hemisphere.sheet.points
    row = sheet[:, sheet.shape[1] // 2]
    center = row.mean(axis=(0, 1))
    # The row lies across the body, whatever way that runs: the slice is cut along it.
    normal = np.linalg.svd((row - center).reshape(-1, 3), full_matrices=False)[2][2]
    right = np.cross(normal, [0, 0, 1])
    right *= np.sign(right[0]) / np.linalg.norm(right)
    up = np.cross(right, normal)
    across = np.array([right, up * np.sign(up[2])])
    x, z = (np.arange(-reach, reach, VOXEL / 2) for reach in REACH)
    place = center + x[:, None, None] * across[0] + z[None, :, None] * across[1]
    index = np.rint((place - affine[:3, 3]) / VOXEL).astype(int)
    cut = codes[tuple(np.moveaxis(np.clip(index, 0, np.array(codes.shape) - 1), -1, 0))]
    axis.pcolormesh(
        x, z, cut.T, cmap=shown, vmin=-0.5, vmax=8.5, alpha=0.5, shading="nearest", rasterized=True
    )
    flat = (row - center) @ across.T
    axis.add_collection(LineCollection(list(flat), colors="black", linewidths=0.7))
    for wall in (0, -1):
        axis.plot(*flat[:, wall].T, color="black", linewidth=1.6)
    axis.set_aspect("equal")
    axis.set_axis_off()
    axis.plot([-REACH[0], -REACH[0] + 5], [-REACH[1] + 1] * 2, color="black")
    axis.text(-REACH[0] + 2.5, -REACH[1] + 1.3, "5 mm", ha="center", va="bottom")


def main() -> None:
    """Read the command line, measure, draw, save."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("templates", type=Path, help=f"the folder that holds {NAME}")
    parser.add_argument("picture", type=Path, help="the PNG file to write")
    parser.add_argument("--region", default="body", help="with a head, its sheet alone is drawn")
    options = parser.parse_args()
    mpl.rcParams.update({"font.size": 10})
    codes, affine = draw_labels(options.templates, SIDE)
    maps = hb.measure(codes, SIDE, "hippunfold", affine=affine, region=options.region)
    print(maps.decision, maps.message, maps.summary["thickness_mean"])  # noqa: T201
    whole = options.region != "body"
    figure = Figure(figsize=(7.5, 4.6) if whole else (11, 3.6))
    if not whole:
        draw_slice(figure.add_axes((0.01, 0.02, 0.32, 0.84)), codes, affine, maps)
    box = (0.0, 0.02, 0.5, 0.94) if whole else (0.34, 0.02, 0.34, 0.84)
    axis: Any = figure.add_axes(box, projection="3d")
    hb.plot_surface(maps, ax=axis, limits=LIMITS, colorbar=False, view=(40, -40))
    sizes = [np.ptp(limits) for limits in (axis.get_xlim(), axis.get_ylim(), axis.get_zlim())]
    axis.set_box_aspect(sizes, zoom=1.25)
    axis = figure.add_axes((0.5, 0.12, 0.46, 0.84) if whole else (0.715, 0.14, 0.26, 0.72))
    hb.plot_sheet(maps, ax=axis, limits=LIMITS)
    axis.set_title("")
    for left, title in () if whole else zip((0.16, 0.51, 0.845), TITLES, strict=True):
        figure.text(left, 0.93, title, ha="center", va="center", weight="bold", size=12)
    figure.savefig(options.picture, dpi=100)


if __name__ == "__main__":
    main()
