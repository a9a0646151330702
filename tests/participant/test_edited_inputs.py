"""Labels and masks corrected by hand, through the command line, on a phantom with a bar."""

import shutil

import nibabel as nib
import numpy as np
import pytest
from input_cases import describe, save
from measured_phantoms import Damage, measured, results, spiral

from hipsta_bids.cli import main
from hipsta_bids.errors import ExitCode
from hipsta_bids.io import files
from hipsta_bids.phantom import encode
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import GridSettings, Settings

#: Coarse, for speed.
SETTINGS = Settings(grid=GridSettings(spacing=0.5))
SEG = "freesurfer"


def run(data, out, *options):
    settings = data.parent / "settings.toml"
    settings.write_text("[grid]\nspacing = 0.5\n")
    arguments = [data, out, "participant", "--settings", settings, *options]
    return main.main(list(map(str, arguments)))


def folder_of(data, subject):
    return data / "derivatives" / SEG / f"sub-{subject}" / "mri"


@pytest.fixture(scope="module")
def case():
    return measured(spiral(length=8.0), settings=SETTINGS)


@pytest.fixture(scope="module")
def barred(case):
    """A thick bar joins CA3 to the subiculum."""
    damage = Damage(case)
    bar = damage.bar((0.15, 0.5, 0.0), (0.85, 0.5, 0.0), 1.2)
    return damage.relabel(bar, Tissue.SUBICULUM)


@pytest.fixture
def data(tmp_path, case, barred):
    """One subject undamaged, two with the bar."""
    data = tmp_path / "data"
    describe(data, kind="raw")
    for subject, volume in (("01", case.volume), ("02", barred), ("03", barred)):
        path = folder_of(data, subject) / "lh.hippoAmygLabels.mgz"
        save(path, encode(volume), volume.affine)
    return data


def thickness(out, subject):
    return results(out, subject, "L", SEG).sheet.thickness.to_numpy()


def statuses(out):
    rows = files.read_tsv(out / "status.tsv")
    return {row["subject"]: (row["decision"], row["edited"]) for row in rows}


def test_an_edit_heals_the_map_and_its_removal_brings_the_damage_back(data, tmp_path, case, capsys):
    out, edits = tmp_path / "out", tmp_path / "edits"
    code = run(data, out)
    broken = statuses(out)
    assert broken["sub-01"] == ("use", "n/a")
    assert broken["sub-02"] == broken["sub-03"]
    assert broken["sub-02"][0] != "use"
    # The body is there to be corrected, even if it was refused.
    body = nib.load(results(out, "02", "L", SEG).path("body_mask"))
    whole = nib.load(results(out, "01", "L", SEG).path("body_mask"))
    added = np.asarray(body.dataobj) > np.asarray(whole.dataobj)
    assert np.count_nonzero(added) > 100

    labels = folder_of(data, "02") / "sub-02_hemi-L_desc-edited_dseg.nii.gz"
    save(labels, encode(case.volume).astype(np.int16), case.volume.affine)
    mask = edits / "sub-03" / "anat" / f"sub-03_hemi-L_seg-{SEG}_desc-edited_mask.nii.gz"
    mask.parent.mkdir(parents=True)
    shutil.copy(results(out, "01", "L", SEG).path("body_mask"), mask)
    save(edits / "sub-04" / "anat" / "sub-04_hemi-L_desc-edited_mask.nii", np.ones((2, 2, 2)))
    capsys.readouterr()
    assert run(data, out, "--edited-dir", edits) == ExitCode.OK
    said = capsys.readouterr().out
    assert "note: no labels of sub-04" not in said
    (note,) = [line for line in said.splitlines() if "sub-04" in line]
    assert note.endswith("edited file not used: no labels of sub-04 hemi-L are processed")
    assert "1 unchanged, skipped" in said
    assert statuses(out) == {
        "sub-01": ("use", "n/a"),
        "sub-02": ("use", "labels"),
        "sub-03": ("use", "mask"),
    }
    # The same labels give the same map.
    np.testing.assert_array_equal(thickness(out, "02"), thickness(out, "01"))
    # A mask does not bring back the dentate gyrus that the bar painted over. That turns the end
    # planes a little, and the mesh with them: columns move by less than what counts as damage.
    np.testing.assert_allclose(thickness(out, "03"), thickness(out, "01"), atol=0.15)
    assert thickness(out, "03").mean() == pytest.approx(thickness(out, "01").mean(), abs=0.02)
    record = results(out, "03", "L", SEG).metrics
    address = f"bids:edited:sub-03/anat/{mask.name}"
    assert record["edited"] == [{"what": "mask", "file": address, "sha256": files.sha256_of(mask)}]
    change = record["metrics"]["mask_change"]
    assert change["added"] == 0
    assert change["removed"] > 100  # the bar
    assert "mask_change" not in results(out, "02", "L", SEG).metrics["metrics"]
    assert "sub-02_hemi-L_seg-freesurfer: edited labels: " in "".join(
        path.read_text() for path in (out / "logs").glob("*.log")
    )

    labels.unlink()
    assert run(data, out) == code
    assert statuses(out) == broken


def test_a_mask_on_a_turned_and_finer_grid_gives_the_same_body(data, tmp_path):
    """Other programs flip axes and resample."""
    out = tmp_path / "out"
    run(data, out, "--participant-label", "01")
    whole = nib.load(results(out, "01", "L", SEG).path("body_mask"))
    before = thickness(out, "01")
    inside = np.asarray(whole.dataobj)
    fine = inside.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
    # Halved voxels; then the first and the last axis change places, and the last is reversed.
    halved = np.diag([0.5, 0.5, 0.5, 1.0])
    halved[:3, 3] = -0.25
    turned = np.eye(4)[[2, 1, 0, 3]]
    turned[0] = [0, 0, -1, fine.shape[0] - 1]
    affine = whole.affine @ halved @ turned
    fine = fine[::-1].transpose(2, 1, 0)
    save(folder_of(data, "01") / "sub-01_hemi-L_desc-edited_mask.nii.gz", fine, affine)
    assert run(data, out, "--participant-label", "01") == ExitCode.OK
    assert statuses(out)["sub-01"] == ("use", "mask")
    np.testing.assert_array_equal(thickness(out, "01"), before)
