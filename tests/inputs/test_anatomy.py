"""Which anatomical image goes with which kind of segmentation; names alone decide here."""

import pytest
from input_cases import touch

from hipsta_bids.inputs.search import find_anatomy
from hipsta_bids.types import Hemisphere

LEFT = Hemisphere(subject="01", session=None, hemi="L")


def found(root, labels, hemisphere=LEFT):
    """List the candidates as their paths below a folder, and whether their space is proven."""
    return [
        (str(candidate.path.relative_to(root)), candidate.proven)
        for candidate in find_anatomy(root / labels, hemisphere, root)
    ]


def test_freesurfer_s_labels_go_with_images_of_their_own_folder(tmp_path):
    mri = "derivatives/freesurfer/sub-01/mri"
    labels = f"{mri}/lh.hippoAmygLabels-T1.v22.mgz"
    touch(tmp_path, labels, "sub-01/anat/sub-01_T1w.nii.gz", f"{mri}/orig.mgz")
    # The scan before FreeSurfer moved it is in another space.
    assert found(tmp_path, labels) == []
    touch(tmp_path, f"{mri}/brain.mgz", f"{mri}/norm.mgz")
    assert found(tmp_path, labels) == [(f"{mri}/norm.mgz", True), (f"{mri}/brain.mgz", True)]


@pytest.mark.parametrize("final", ["final/", ""])
def test_ashs_s_labels_go_with_the_image_that_it_segmented(tmp_path, final):
    folder = "derivatives/ashs/sub-01"
    labels = f"{folder}/{final}sub-01_left_lfseg_corr_usegray.nii.gz"
    touch(tmp_path, labels, f"{folder}/mprage.nii.gz", f"{folder}/tse.nii.gz")
    touch(tmp_path, "sub-01/anat/sub-01_T2w.nii.gz", "sub-01/anat/sub-01_T1w.nii.gz")
    touch(tmp_path, *(f"{folder}/tse_native_chunk_{side}.nii.gz" for side in ("left", "right")))
    assert found(tmp_path, labels) == [
        (f"{folder}/tse.nii.gz", True),
        (f"{folder}/tse_native_chunk_left.nii.gz", True),
        # Only a header can tell whether ASHS was given this file.
        ("sub-01/anat/sub-01_T2w.nii.gz", False),
        ("sub-01/anat/sub-01_T1w.nii.gz", False),
    ]


def test_hippunfold_s_crops_go_with_the_crop_of_their_side(tmp_path):
    anat = "derivatives/hippunfold/sub-01/ses-1/anat"
    name = f"{anat}/sub-01_ses-1_hemi-L_space-cropT1w_desc-subfields_atlas-bigbrain_dseg.nii.gz"
    crops = [
        f"{anat}/sub-01_ses-1_hemi-{hemi}_space-{space}_desc-preproc_T1w.nii.gz"
        for hemi in "LR"
        for space in ("cropT1w", "corobl")
    ]
    raw = [f"sub-01/ses-{session}/anat/sub-01_ses-{session}_T1w.nii.gz" for session in "12"]
    touch(tmp_path, name, *crops, *raw)
    left = Hemisphere(subject="01", session="1", hemi="L")
    # First that of the same space and side; the whole image of the visit; last what may not fit.
    assert found(tmp_path, name, left) == [(crops[0], True), (raw[0], True), (crops[1], False)]


def test_of_several_runs_none_is_taken_for_the_space_of_the_labels(tmp_path):
    labels = "derivatives/own/sub-01/anat/sub-01_hemi-L_space-T1w_dseg.nii.gz"
    runs = [f"sub-01/anat/sub-01_run-{n}_T1w.nii.gz" for n in (1, 2)]
    touch(tmp_path, labels, *runs)
    assert found(tmp_path, labels) == [(run, False) for run in runs]
    (tmp_path / runs[1]).unlink()
    assert found(tmp_path, labels) == [(runs[0], True)]


def test_other_files_are_no_anatomical_images(tmp_path):
    labels = "derivatives/hsf/sub-01/anat/sub-01_T2w_left_hippocampus_seg.nii.gz"
    anat = "sub-01/anat/sub-01"
    touch(tmp_path, labels, f"{anat}_T2w.json", f"{anat}_mask.nii.gz", f"{anat}_FLAIR.nii.gz")
    assert found(tmp_path, labels) == []
    assert found(tmp_path / "nowhere", "sub-01_hemi-L_dseg.nii.gz") == []
