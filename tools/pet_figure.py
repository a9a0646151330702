"""Draw the figure of docs/pet-fmri.md: a synthetic hemisphere with PET and a time series.

.venv/bin/python tools/pet_figure.py
"""

import tempfile
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
from matplotlib.figure import Figure
from nibabel.affines import apply_affine

import hipsta_bids as hb
from hipsta_bids.cli.main import main as run_command

IMAGE = Path(__file__).resolve().parents[1] / "docs/images/pet-fmri.png"
VOXEL = 2.0  # mm
#: From the labels' scanner space to the PET image's, RAS mm, and the same in LPS, as ITK has it.
MOTION = np.eye(4)
MOTION[:3, :3] = np.array([[0.96, -0.28, 0], [0.28, 0.96, 0], [0, 0, 1]])
LPS = np.diag([-1.0, -1, 1, 1])


def write_images(folder: Path) -> None:
    """Write PET, whose signal rises to anterior, in a space of its own, and a time series."""
    labels: Any = nib.load(next(folder.rglob("lh.hippoAmygLabels*.mgz")))
    voxels = np.argwhere(np.asanyarray(labels.dataobj) > 0)
    points = apply_affine(labels.affine, voxels)
    low, high = points.min(axis=0) - 10, points.max(axis=0) + 10
    affine = np.diag([VOXEL, VOXEL, VOXEL, 1])
    affine[:3, 3] = low
    grid = np.indices(np.ceil((high - low) / VOXEL).astype(int))
    places = apply_affine(affine, np.moveaxis(grid, 0, -1))
    share = (places[..., 1] - low[1]) / (high - low)[1]
    random = np.random.default_rng(0)
    pet = 1 + share + 0.05 * random.standard_normal(share.shape)
    series = 100 + 5 * random.standard_normal((*share.shape, 40)) - 20 * share[..., None]
    nib.save(nib.Nifti1Image(pet.astype(np.float32), MOTION @ affine), folder / "pet.nii.gz")
    nib.save(nib.Nifti1Image(series.astype(np.float32), affine), folder / "bold.nii.gz")
    matrix = LPS @ MOTION @ LPS
    numbers = " ".join(map(str, [*matrix[:3, :3].ravel(), *matrix[:3, 3]]))
    (folder / "pet.txt").write_text(
        "#Insight Transform File V1.0\n#Transform 0\nTransform: AffineTransform_double_3_3\n"
        f"Parameters: {numbers}\nFixedParameters: 0 0 0\n"
    )


def main() -> None:
    """Measure a synthetic hemisphere and draw its maps."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run_command(["phantom", str(folder / "bids"), "--n-subjects", "1", "--seed", "1"])
        write_images(folder)
        options = ["--map", f"pet={folder}/pet.nii.gz", f"bold={folder}/bold.nii.gz"]
        options += ["--map-transform", f"pet={folder}/pet.txt", "--no-reports"]
        run_command([str(folder / "bids"), str(folder / "out"), "participant", *options])
        left = hb.load(folder / "out").maps.sel(side="L").squeeze().load()
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for axis, measure in zip(figure.subplots(1, 3), ("thickness", "pet", "bold"), strict=True):
        hb.plot_sheet(left, measure, ax=axis)
    figure.savefig(IMAGE, dpi=80)


if __name__ == "__main__":
    main()
