"""Paths with placeholders: filled for one hemisphere, and found for all."""

import pytest

from hipsta_bids.errors import UsageError
from hipsta_bids.inputs.maps import check_pattern, fill, find, scan


def touch(root, *names):
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def labels(found):
    return [(one.subject, one.session, one.hemi) for one in found]


def test_what_is_found_is_what_is_filled(tmp_path):
    pattern = "d/sub-{subject}/ses-{session}/sub-{subject}_ses-{session}_hemi-{hemi}_[!x]*.gii"
    names = [fill(pattern, "A1", "2", "L"), fill(pattern, "B", None, "R")]
    assert names == [
        "d/sub-A1/ses-2/sub-A1_ses-2_hemi-L_[!x]*.gii",
        "d/sub-B/sub-B_hemi-R_[!x]*.gii",
    ]
    touch(
        tmp_path,
        "d/sub-A1/ses-2/sub-A1_ses-2_hemi-L_y.gii",
        "d/sub-A1/ses-2/sub-A1_ses-2_hemi-L_x.gii",  # not in the set of characters
        "d/sub-A1/ses-2/sub-A2_ses-2_hemi-L_y.gii",  # two subjects in one path
        "d/sub-B/sub-B_hemi-R_y.gii",
    )
    found = scan(pattern, tmp_path)
    assert labels(found) == [("A1", "2", "L"), ("B", None, "R")]
    assert [one.path for one in found] == [find(name, tmp_path)[0] for name in names]


def test_sides_wildcards_and_absolute_patterns(tmp_path):
    touch(tmp_path, "a/b/sub-1/mri/lh.x.txt", "sub-2/mri/rh.x.txt", "sub-3/mri/xh.x.txt")
    for pattern in (
        "**/sub-{subject}/mri/{side}.?.txt",
        f"{tmp_path}/**/sub-{{subject}}/*/{{side}}.*",
    ):
        assert sorted(labels(scan(pattern, tmp_path))) == [("1", None, "L"), ("2", None, "R")]


def test_hemisphere_need_not_be_in_the_path(tmp_path):
    touch(tmp_path, "sub-1_left.txt", "sub-1_right.txt")
    assert labels(scan("sub-{subject}_*.txt", tmp_path)) == [("1", None, None)] * 2


@pytest.mark.parametrize("pattern", ["{subjec}.gii", "{subject.gii", "{}"])
def test_unknown_placeholders_are_refused(pattern):
    with pytest.raises(UsageError, match=r"placeholders are \{subject\}"):
        check_pattern("--maps", "x", pattern)
