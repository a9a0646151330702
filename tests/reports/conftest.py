"""A small dataset with a hemisphere of each kind, measured once, and its pages."""

import contextlib
import io
import shutil
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from hipsta_bids.cli import main

#: FreeSurfer's codes of the sheet: presubiculum, subiculum, CA1, CA3 (body).
SHEET = (234, 236, 238, 240)
CA1 = 238


def edit(path, change):
    """Change the labels of an image in place, given the codes and all voxels' distances."""
    image = nib.load(path)
    codes = np.asarray(image.dataobj).copy()
    index = np.moveaxis(np.indices(codes.shape), 0, -1)
    change(codes, index)
    nib.save(nib.MGHImage(codes, image.affine, image.header), path)


def leak(codes, index):
    """CA1 all over the middle: measured, but flagged."""
    body = np.argwhere(np.isin(codes, SHEET))
    ball = np.linalg.norm(index - (body.min(0) + body.max(0)) / 2, axis=-1) < 9
    codes[ball & ~np.isin(codes, SHEET)] = CA1


def interrupt(codes, index):
    """Nothing in the middle, across the whole body: cannot be measured."""
    body = np.argwhere(np.isin(codes, SHEET))
    length = index[..., 2] - (body[:, 2].min() + body[:, 2].max()) // 2
    codes[np.abs(length) < 4] = 0


def bridge(codes, index):
    """A thin bar from presubiculum to CA3: measured after repair."""
    body = np.argwhere(np.isin(codes, SHEET))
    middle = (body[:, 2].min() + body[:, 2].max()) // 2
    ends = [np.argwhere((codes == code) & (index[..., 2] == middle)) for code in (234, 240)]
    gaps = np.linalg.norm(ends[0][:, None] - ends[1][None], axis=-1)
    a, b = np.unravel_index(gaps.argmin(), gaps.shape)
    line = np.linspace(ends[0][a], ends[1][b], 60)
    near = np.linalg.norm(index[..., None, :] - line, axis=-1).min(axis=-1) < 1.1
    codes[near & ~np.isin(codes, SHEET)] = CA1


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Let runs make pages here."""


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    """Folder with ``in`` and ``out``: 01 L ok, 01 R repaired, 02 L flagged, 02 R failed."""
    folder = tmp_path_factory.mktemp("reports")
    source = folder / "in"
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert main.main(["phantom", str(source), "--n-subjects", "2", "--seed", "1"]) == 0
        labels = source / "derivatives" / "freesurfer"
        for subject, side, change in (
            ("01", "rh", bridge),
            ("02", "lh", leak),
            ("02", "rh", interrupt),
        ):
            (path,) = (labels / f"sub-{subject}" / "mri").glob(f"{side}.hippo*.mgz")
            edit(path, change)
        assert main.main([str(source), str(folder / "out"), "participant", "--n-procs", "1"]) == 1
    return folder


def make_anatomy(folder, name="norm.mgz", dtype=np.uint8):
    """Write an image of 1 mm beside FreeSurfer's labels: dark in them, noise on a slope outside."""
    paths = sorted(folder.glob("?h.hippo*.mgz"))
    images = [nib.load(path) for path in paths]
    corners = np.stack(np.meshgrid(*[[0, 1]] * 3), axis=-1).reshape(-1, 3)
    ends = [nib.affines.apply_affine(i.affine, corners * i.shape) for i in images]
    low, high = np.min(ends, axis=(0, 1)) - 12, np.max(ends, axis=(0, 1)) + 12
    shape = np.ceil(high - low).astype(int)
    affine = np.diag([1.0, 1.0, 1.0, 1.0])
    affine[:3, 3] = low
    points = nib.affines.apply_affine(affine, np.moveaxis(np.indices(shape), 0, -1))
    values = 120 + (points[..., 1] - low[1]) + np.random.default_rng(3).normal(0, 6, shape)
    for image in images:
        index = nib.affines.apply_affine(np.linalg.inv(image.affine), points).round().astype(int)
        inside = ((index >= 0) & (index < image.shape)).all(axis=-1)
        codes = np.asarray(image.dataobj)[tuple(index[inside].T)]
        values[inside] = np.where(codes > 0, 40 + codes % 7, values[inside])
    nib.save(nib.MGHImage(values.clip(0, 255).astype(dtype), affine), folder / name)
    return folder / name


@pytest.fixture(scope="session")
def shown(dataset, tmp_path_factory):
    """Output dataset of which the page of 01 shows an anatomical image behind the labels."""
    folder = shutil.copytree(dataset, tmp_path_factory.mktemp("anatomy") / "data")
    make_anatomy(folder / "in/derivatives/freesurfer/sub-01/mri")
    again = [str(folder / "in"), str(folder / "out"), "participant", "--reports-only"]
    with contextlib.redirect_stdout(io.StringIO()):
        assert main.main([*again, "--participant-label", "01", "--n-procs", "1"]) == 0
    return folder / "out"


@pytest.fixture(scope="session")
def out(dataset) -> Path:
    """The output dataset, with its pages."""
    return dataset / "out"
