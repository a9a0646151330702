"""Labels of tables that a spreadsheet or a person wrote in another way than the data have them."""

import pytest

from hipsta_bids.errors import InputError
from hipsta_bids.io.labels import match_labels

DATA = [f"sub-{i:02d}" for i in range(1, 25)]


def test_zeros_that_a_spreadsheet_took_are_found_one_to_one():
    matches, notes = match_labels([f"sub-{i}" for i in range(1, 25)], DATA, "participants.tsv")
    assert matches == {f"sub-{i}": f"sub-{i:02d}" for i in range(1, 10)}
    assert notes == ["participants.tsv: sub-1 is read as sub-01 (9 labels alike)"]


@pytest.mark.parametrize(
    ("label", "known"),
    [
        ("sub-1.0", "sub-01"),
        ("sub-ADNI_002_S", "sub-ADNI002S"),
        ("sub-p7", "sub-P007"),
        ("ses-1", "ses-01"),
        ("ses-M6", "ses-m06"),
    ],
)
def test_signs_capitals_and_decimals_do_not_matter(label, known):
    assert match_labels([label], [known, "sub-99"], "t")[0] == {label: known}


def test_equal_labels_are_not_noted_and_others_are_no_matches():
    assert match_labels([*DATA, "sub-100"], DATA, "t") == ({}, [])
    assert match_labels(["sub-1", "sub-01"], ["sub-01", "sub-1"], "t") == ({}, [])


@pytest.mark.parametrize(
    ("labels", "data"),
    [
        (["sub-1", "sub-01"], ["sub-01"]),
        (["sub-1"], ["sub-01", "sub-001"]),
        (["sub-1", "sub-001"], ["sub-01", "sub-2"]),
    ],
)
def test_what_is_not_one_to_one_is_refused(labels, data):
    with pytest.raises(InputError, match=f"{labels[0]}.* may be {data[0]}"):
        match_labels(labels, data, "participants.tsv")
