"""``--method published``: Diers et al. 2023 as a preset, and each part of it alone."""

import json

import numpy as np
import pytest
from measured_phantoms import results
from scipy import ndimage

from hipsta_bids.cli import main
from hipsta_bids.derivatives.names import DATASET_FILES
from hipsta_bids.errors import ExitCode
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.phantom import Hemisphere, Phantom, PhantomSpec, write_dataset
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.toml import flatten, resolve
from hipsta_bids.settings import PUBLISHED, BodySettings, Settings
from hipsta_bids.types import LabelVolume

SPEC = PhantomSpec(kind="spiral", thickness=2.0, length=10.0)


@pytest.fixture(scope="module")
def bids_dir(tmp_path_factory):
    root = tmp_path_factory.mktemp("published") / "bids"
    write_dataset(root, [Hemisphere(subject="01", hemi="L", spec=SPEC)], voxel_size=(0.4, 0.4, 0.4))
    return root


def run(bids_dir, out, *options):
    return main.main([str(bids_dir), str(out), "participant", "--n-procs", "1", *options])


def test_a_published_run_says_so_and_no_other_run_joins_it(bids_dir, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(bids_dir, out, "--method", "published") == ExitCode.OK
    sheet = results(out, "01", "L", "freesurfer").sheet
    (record,) = (json.loads(path.read_text()) for path in out.rglob("*_desc-qc_metrics.json"))
    assert record["as_published"] == [
        f"{group}.{name}" for group in PUBLISHED for name in PUBLISHED[group]
    ]
    # Beside the edges the published x depends on the mesh; in the middle 2 mm are 2 mm.
    middle = sheet[sheet.x.between(10, 30)]
    assert middle.thickness.mean() == pytest.approx(2.0, abs=0.05)
    assert sheet.thickness.mean() == pytest.approx(2.0, abs=0.1)
    recorded = flatten(json.loads((out / DATASET_FILES["settings"]).read_text())["settings"])
    wanted = flatten({group: dict(values) for group, values in PUBLISHED.items()})
    assert {key: recorded[key] for key in wanted} == wanted
    text = (out / "CITATION.md").read_text()
    assert "dilated and eroded" in text
    assert "without a threshold of curvature" in text
    assert "solved for on the mid-surface" not in text
    capsys.readouterr()
    assert run(bids_dir, out) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert "results with other settings (body.end_rule was last-slice, now graded" in said
    assert said.count("\n") == 1


def test_each_part_of_the_preset_differs_from_the_default():
    default = flatten(resolve(Settings()))
    for key, value in flatten({k: dict(v) for k, v in PUBLISHED.items()}).items():
        assert default[key] != value
    assert Settings().as_published() == []


def test_closing_adds_what_dilation_and_erosion_do():
    """Holes of a voxel, and narrow gaps between folds, which are left open otherwise."""
    volume = Phantom(SPEC).label_volume(load_protocol("freesurfer"), voxel_size=(0.5, 0.5, 0.5))
    random = np.random.default_rng(2)
    sheet = np.isin(volume.tissue, (*volume.protocol.sheet, *volume.protocol.layer))
    inner = ndimage.binary_erosion(sheet)
    holes = inner & (random.random(sheet.shape) < 0.02)
    damaged = LabelVolume(
        tissue=np.where(holes, 0, volume.tissue),
        part=np.where(holes, 0, volume.part),
        affine=volume.affine,
        protocol=volume.protocol,
    )
    closed = extract_body(damaged, BodySettings(mending="closing"))
    wanted = ndimage.binary_closing(sheet & ~holes, structure=np.ones((3, 3, 3)))
    np.testing.assert_array_equal(closed.tissue > 0, wanted)
    assert (closed.tissue[holes] > 0).mean() > 0.9
    assert set(np.unique(closed.tissue)) == set(np.unique(volume.tissue[sheet])) | {0}
    assert len(closed.filled) == (wanted & ~(sheet & ~holes)).sum()
