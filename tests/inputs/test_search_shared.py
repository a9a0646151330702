"""Real labels of three brains, where the shared test data are at hand."""

from pathlib import Path

import numpy as np
import pytest
from input_cases import by_key, find

from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.protocols.protocol import Part, Tissue

DATA = Path(__file__).parents[2] / ".." / "shared" / "data" / "cobralab"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="shared test data not found")


@pytest.fixture(scope="module")
def found():
    return by_key(find(DATA))


def test_all_twelve_are_found_with_the_right_files(found):
    names = {key: [path.name for path in item.files] for key, item in found.items()}
    expected = {}
    for hemi, side, word in (("L", "lh", "left"), ("R", "rh", "right")):
        newer, combined = "hippoAmygLabels-T1.v22", "hippoAmygLabels-T1-T2.v21"
        expected["01", "", hemi, "freesurfer"] = [f"{side}.{newer}.mgz"]
        expected["02", "", hemi, "freesurferCA"] = [
            f"{side}.{combined}.CA.mgz",
            f"{side}.{combined}.HBT.mgz",
        ]
        expected["03", "", hemi, "freesurfer"] = [f"{side}.hippoAmygLabels.mgz"]
        for subject in ("01", "02", "03"):
            name = f"sub-{subject}_{word}_lfseg_corr_usegray.nii.gz"
            expected[subject, "", hemi, "ashsABC3T"] = [name]
    assert names == expected
    assert all(item.problem is None for item in found.values())


def test_the_third_brains_atlas_is_known_from_the_others(found):
    for hemi in "LR":
        why = found["03", "", hemi, "ashsABC3T"].explanation
        assert "fit ashsABC3T and ashsPMC" in why
        assert "4 other files" in why
    (alone,) = find(
        DATA, ashs_dir=DATA / "derivatives" / "ashs", participant_labels=("03",), hemis=("L",)
    )[:1]
    assert alone.protocol.name == "ashsABC3T"


def test_all_twelve_can_be_read(found):
    for (subject, _, _, protocol), item in found.items():
        volume = read_label_volume(item)
        tissues = set(np.unique(volume.tissue).tolist())
        parts = set(np.unique(volume.part).tolist()) - {Part.UNKNOWN}
        assert tissues >= {Tissue.SUBICULUM, Tissue.CA1, Tissue.DENTATE_GYRUS}
        # The README of the data says which ASHS files have head and tail labels.
        with_parts = {"01": {Part.HEAD, Part.TAIL}, "02": {Part.TAIL}, "03": set()}
        every = {Part.HEAD, Part.BODY, Part.TAIL}
        assert parts == (with_parts[subject] if protocol == "ashsABC3T" else every)


def test_freesurfer_hierarchies_of_one_brain_agree(found):
    """The full hierarchy and .CA with .HBT say the same of head, body and tail."""
    item = found["01", "", "L", "freesurfer"]
    full = read_label_volume(item)
    folder = item.files[0].parent
    stem = item.files[0].name.removesuffix(".mgz")
    other = found["02", "", "L", "freesurferCA"]
    combined = read_label_volume(
        type(item)(
            subject="01",
            session=None,
            hemi="L",
            protocol=other.protocol,
            parts_protocol=other.parts_protocol,
            files=(folder / f"{stem}.CA.mgz", folder / f"{stem}.HBT.mgz"),
            source=item.source,
            source_path=item.source_path,
            explanation="test",
        )
    )
    np.testing.assert_array_equal(full.part, combined.part)
    np.testing.assert_array_equal(full.tissue > 0, combined.tissue > 0)
    np.testing.assert_allclose(full.affine, combined.affine, atol=1e-6)  # single-precision headers
