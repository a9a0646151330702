"""Draw the figure of docs/regions.md: a whole hippocampus as a sheet, in space and unfolded.

The labels are drawn from HippUnfold's surfaces of the template OASIS30ANTs (MIT license,
see docs/images/regions-whole.LICENSE.txt), which the folder TEMPLATES holds::

    .venv/bin/python tools/regions_figure.py TEMPLATES docs/images/regions-whole.png
"""

import argparse
from pathlib import Path
from typing import Any

import matplotlib as mpl
import nibabel as nib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import hipsta_bids as hb

NAME = "tpl-OASIS30ANTs"
VOXEL = 0.3  # mm
STEPS = 6  # points along the edge of a triangle, and across the wall: closer than a voxel
LIMITS = (1.3, 2.4)  # mm, ends of the colors
SIDE = "R"
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


def main() -> None:
    """Read the command line, measure, draw, save."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("templates", type=Path, help=f"the folder that holds {NAME}")
    parser.add_argument("picture", type=Path, help="the PNG file to write")
    options = parser.parse_args()
    mpl.rcParams.update({"font.size": 10})
    codes, affine = draw_labels(options.templates, SIDE)
    maps = hb.measure(codes, SIDE, "hippunfold", affine=affine, region="whole")
    print(maps.decision, maps.message, maps.summary["thickness_mean"])  # noqa: T201
    figure = Figure(figsize=(7.5, 4.6))
    axis: Any = figure.add_axes((0.0, 0.02, 0.5, 0.94), projection="3d")
    hb.plot_surface(maps, ax=axis, limits=LIMITS, colorbar=False, view=(40, -40))
    sizes = [np.ptp(limits) for limits in (axis.get_xlim(), axis.get_ylim(), axis.get_zlim())]
    axis.set_box_aspect(sizes, zoom=1.25)
    axis = figure.add_axes((0.5, 0.12, 0.46, 0.84))
    hb.plot_sheet(maps, ax=axis, limits=LIMITS)
    axis.set_title("")
    figure.savefig(options.picture, dpi=100)


if __name__ == "__main__":
    main()
