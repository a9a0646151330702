"""Layers of equal volume, through the command line: means over depth, and the table of layers."""

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from measured_phantoms import results

from hipsta_bids.cli import main
from hipsta_bids.derivatives.names import output_path
from hipsta_bids.errors import ExitCode
from hipsta_bids.io import files
from hipsta_bids.phantom import Hemisphere, Phantom, PhantomSpec, write_dataset

#: Radius 4 mm, so that the wall is 5 / 3 times as wide outside as inside.
SPEC = PhantomSpec(kind="arc", thickness=2.0, length=8.0)


@pytest.fixture(scope="module")
def bids_dir(tmp_path_factory):
    """One hemisphere, and an image of the distance from the middle of its wall."""
    bids = tmp_path_factory.mktemp("layers") / "bids"
    write_dataset(bids, [Hemisphere(subject="01", hemi="L", spec=SPEC)])
    labels = nib.load(next(bids.rglob("lh.hippoAmygLabels*.mgz")))
    index = np.moveaxis(np.indices(labels.shape), 0, -1)
    points = nib.affines.apply_affine(labels.affine, index).reshape(-1, 3)
    off = Phantom(SPEC).body.locate(points, reach=3.0)[:, 2]
    image = nib.Nifti1Image(off.reshape(labels.shape).astype(np.float32), labels.affine)
    image.set_sform(labels.affine, 1)
    nib.save(image, bids / "off.nii.gz")
    return bids


def run(bids_dir, out, depths):
    settings = bids_dir.parent / f"{depths}.toml"
    settings.write_text(f'[sheet]\ndepths = "{depths}"\n')
    options = [
        "--settings",
        str(settings),
        "--map",
        "off=off.nii.gz",
        "--write-meshes",
        "--n-procs",
        "1",
    ]
    assert main.main([str(bids_dir), str(out), "participant", *options]) == ExitCode.OK
    return results(out, "01", "L", "freesurfer")


@pytest.fixture(scope="module")
def found(bids_dir, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    return {depths: run(bids_dir, out / depths, depths) for depths in ("distance", "volume")}


def inner(values):
    return values.to_numpy().reshape(41, 21)[8:-8, 3:-3]


def test_the_mean_over_depth_weights_layers_by_volume(found):
    means = {}
    for depths, result in found.items():
        path = result.out / output_path(result.name, "map_table", "off")
        means[depths] = inner(pd.read_csv(path, sep="\t").iloc[:, -1])
    # The mean of n weighted by 1 + k n over a wall of thickness T is k T^2 / 12, here 0.083 mm.
    gain = np.nanmean(means["volume"] - means["distance"])
    assert gain == pytest.approx(0.25 * 2.0**2 / 12, rel=0.1)  # voxels of 0.4 mm
    assert abs(np.nanmean(means["distance"])) < 0.04  # mm, a tenth of a voxel


def test_every_other_number_stays(found):
    first, second = found["distance"], found["volume"]
    pd.testing.assert_frame_equal(first.sheet, second.sheet)
    assert first.summary == second.summary
    for key in ("profile", "sections", "midthickness_surface"):
        assert first.path(key).read_bytes() == second.path(key).read_bytes()


def test_the_table_of_layers(found):
    for depths, middle in (("distance", 0.5), ("volume", 0.5 + 0.25 * 2.0 / 8)):
        table = pd.read_csv(found[depths].path("layers"), sep="\t")
        assert len(table) == 41 * 21 * 9
        ends = table[table.layer.isin([1, 9])].relative_depth
        assert sorted(set(ends)) == [0.0, 1.0]
        half = inner(table[table.layer == 5].relative_depth)
        # To first order 1/2 + k T / 8; the rest is of second order, 0.004.
        assert half.mean() == pytest.approx(middle, abs=0.008)
    assert (
        "head and tail" in files.read_json(found["volume"].path("layers_sidecar"))["MeasuredRegion"]
    )
