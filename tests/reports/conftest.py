"""A small dataset with a hemisphere of each kind, measured once, and its pages."""

import contextlib
import io
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
    near = np.linalg.norm(index[..., None, :] - line, axis=-1).min(axis=-1) < 1.5
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


@pytest.fixture(scope="session")
def out(dataset) -> Path:
    """The output dataset, with its pages."""
    return dataset / "out"
