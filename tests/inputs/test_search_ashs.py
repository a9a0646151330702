import gzip

import numpy as np
import pytest
from input_cases import by_key, describe, find, save_values, touch

from hipsta_bids.errors import ProtocolError
from hipsta_bids.inputs import ashs

GRAY = "lfseg_corr_usegray.nii.gz"
ABC = [1, 2, 3, 4, 5, 8]
CORTEX = [*ABC, 9, 10, 11, 12]  # ABC-3T or Magdeburg: the body is the same
MAGDEBURG = [*CORTEX, 13]
T1 = [1, 2, 4, 7, 10, 11, 12, 13, 14, 17]
BOTH = [1, 2, 3, 4, 8]  # ABC-3T without tail, or PMC without cortex
PMC = [1, 2, 3, 4, 8, 10, 11, 12, 13]
UTRECHT = [1, 2, 3, 4, 5, 6, 7, 8]

SNAP = """################################################
# ITK-SnAP Label Description File
    0     0    0    0        0  0  0    "Clear Label"
    1   255    0    0        1  1  1    "CA1"
    2     0  255    0        1  1  1    "CA2"
    3   128   64  255        1  1  1    "DG"
    4   255  255    0        1  1  1    "CA3"
    8   240   86  224        1  1  1    "SUB"
   10   210  180  140        1  1  1    "ERC"
"""


def folder(root, subject="sub-01", inner="final"):
    return root / "derivatives" / "ashs" / subject / inner


def left(root, subject="sub-01", values=BOTH):
    return save_values(folder(root, subject) / f"{subject}_left_{GRAY}", values)


def only(root, **options):
    (item,) = find(root, **options)
    return item


@pytest.mark.parametrize(
    "path",
    [
        f"sub-01/final/whoever_left_{GRAY}",
        f"sub-01/final/left_{GRAY}",
        f"sub-01/sub-01_left_{GRAY}",
        f"sub-01/ses-a/final/x_left_{GRAY}",
        f"sub-01/ses-a/x_left_{GRAY}",
        f"sub-01_ses-a/final/x_left_{GRAY}",
        "sub-01/final/sub-99_left_lfseg_heur.nii.gz",
        "sub-01/final/x_left_lfseg_corr_nogray.nii",
    ],
)
def test_the_folder_says_who_it_is(tmp_path, path):
    touch(tmp_path / "derivatives" / "ashs", path)
    item = only(tmp_path, ashs_atlas="ashsPMC")
    assert (item.subject, item.hemi, item.code_offset) == ("01", "L", 0)
    assert item.session == ("a" if "ses-a" in path else None)


def test_the_last_step_of_ashs_comes_first(tmp_path):
    names = [f"x_left_lfseg_{kind}.nii.gz" for kind in ("heur", "corr_nogray", "corr_usegray")]
    touch(folder(tmp_path), *names, f"x_lfseg_{'heur'}.nii.gz")
    found = by_key(find(tmp_path, ashs_atlas="ABC3T"))
    item = found["01", "", "L", "ashsABC3T"]
    assert item.files[0].name == names[2]
    reasons = dict(item.passed_over)
    assert reasons[names[0]] == "corr_usegray is preferred to heur"
    assert "both hemispheres in one file" in reasons["x_lfseg_heur.nii.gz"]


def test_one_file_of_both_hemispheres_gives_two_inputs(tmp_path):
    values = [*ABC, *(value + 100 for value in ABC)]
    save_values(folder(tmp_path) / f"x_{GRAY}", values)
    found = by_key(find(tmp_path))
    assert set(found) == {("01", "", hemi, "ashsABC3T") for hemi in "LR"}
    offsets = {key[2]: (item.bilateral, item.code_offset) for key, item in found.items()}
    assert offsets == {"L": (True, 0), "R": (True, 100)}


def test_files_that_are_equally_good_are_not_chosen_between(tmp_path):
    touch(folder(tmp_path), f"a_left_{GRAY}", f"b_left_{GRAY}")
    item = only(tmp_path, ashs_atlas="ABC3T")
    assert item.problem is not None
    assert item.problem.reason == "several-files"
    assert f"a_left_{GRAY} and b_left_{GRAY}" in str(item.problem)
    # A name that agrees with the folder decides.
    touch(folder(tmp_path), f"sub-01_left_{GRAY}")
    item = only(tmp_path, ashs_atlas="ABC3T")
    assert item.problem is None
    assert item.files[0].name == f"sub-01_left_{GRAY}"


@pytest.mark.parametrize("name", ["ashsUtrecht7T", "utrecht7t", "Utrecht-7T", "ASHS_utrecht7T"])
def test_the_option_decides_and_nothing_is_opened(tmp_path, name):
    touch(folder(tmp_path), f"x_left_{GRAY}")  # empty: opening it would be a problem
    item = only(tmp_path, ashs_atlas=name)
    assert item.protocol.name == "ashsUtrecht7T"
    assert "--ashs-atlas" in item.explanation


def test_an_unknown_atlas_is_refused(tmp_path):
    left(tmp_path)
    with pytest.raises(ProtocolError, match=r"no protocol is called 'ashsABC3'.*mean 'ashsABC3T'"):
        find(tmp_path, ashs_atlas="ashsABC3")


@pytest.mark.parametrize(
    ("values", "protocol"),
    [
        (ABC, "ashsABC3T"),
        ([*CORTEX, 20], "ashsABC3T"),
        (PMC, "ashsPMC"),
        (UTRECHT, "ashsUtrecht7T"),
        (MAGDEBURG, "ashsMagdeburg7T"),
    ],
)
def test_values_decide_if_one_atlas_only_fits(tmp_path, values, protocol):
    left(tmp_path, values=values)
    item = only(tmp_path)
    assert item.protocol.name == protocol
    assert item.problem is None
    assert "only this atlas has labels like these" in item.explanation


def test_ambiguous_values_are_never_guessed(tmp_path):
    path = left(tmp_path)
    item = only(tmp_path)
    assert item.problem is not None
    assert item.problem.reason == "ambiguous-atlas"
    assert str(item.problem) == (
        f"{path}: labels 1, 2, 3, 4, 8 fit ashsABC3T and ashsPMC; name the atlas with --ashs-atlas"
    )
    assert item.protocol.name == "ashs"


def test_two_atlases_with_the_same_body_share_a_name(tmp_path):
    left(tmp_path, values=CORTEX)
    item = only(tmp_path)
    assert item.problem is None
    assert item.protocol.name == "ashsABC3T"
    assert "fit ashsABC3T and ashsMagdeburg7T; the body is the same" in item.explanation
    assert only(tmp_path, ashs_atlas="magdeburg7t").protocol.name == "ashsMagdeburg7T"


def test_one_file_with_a_code_of_its_own_names_the_whole_dataset(tmp_path):
    left(tmp_path, "sub-01", CORTEX)
    left(tmp_path, "sub-02", MAGDEBURG)
    first, second = find(tmp_path)
    assert first.protocol.name == second.protocol.name == "ashsMagdeburg7T"
    assert "fit ashsABC3T and ashsMagdeburg7T; labels of 2 other files" in first.explanation
    # Without it, whichever the others are named by.
    left(tmp_path, "sub-02", [*CORTEX, 20])
    assert {item.protocol.name for item in find(tmp_path)} == {"ashsABC3T"}
    left(tmp_path, "sub-02", BOTH)
    first, second = find(tmp_path)
    assert first.protocol.name == second.protocol.name == "ashsABC3T"
    assert "; the body is the same" in first.explanation


@pytest.mark.parametrize("name", ["T1", "ashsT1", "ASHS-T1"])
def test_an_atlas_without_subfields_is_refused_by_name(tmp_path, name):
    left(tmp_path)
    with pytest.raises(ProtocolError, match=r"no subfields; run ASHS on a T2-.* or") as caught:
        find(tmp_path, ashs_atlas=name)
    assert caught.value.reason == "no-subfields"
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("table", [None, '1 255 0 0 1 1 1 "Left Anterior hippocampus"\n'])
def test_an_atlas_without_subfields_is_refused_by_its_labels(tmp_path, table):
    path = left(tmp_path, values=T1)
    if table:
        (folder(tmp_path) / "snaplabels.txt").write_text(table, encoding="utf-8")
    problem = only(tmp_path).problem
    assert problem is not None
    assert problem.reason == "no-subfields"
    assert str(problem).startswith(f"{path}: ASHS-T1 (ashsT1) divides the hippocampus")


def test_values_that_fit_no_atlas(tmp_path):
    left(tmp_path, values=[1, 2, 3, 77])
    item = only(tmp_path)
    assert item.problem is not None
    assert item.problem.reason == "unknown-atlas"
    assert "1, 2, 3, 77" in str(item.problem)


def test_the_atlas_carries_over_within_a_dataset(tmp_path):
    left(tmp_path, "sub-01", ABC)
    left(tmp_path, "sub-02", BOTH)
    first, second = find(tmp_path)
    assert first.protocol.name == second.protocol.name == "ashsABC3T"
    assert "1 other file of the dataset fit only this one" in second.explanation
    # Also when the other one is not asked for: the choice may not depend on the selection.
    alone = only(tmp_path, participant_labels=("02",))
    assert alone == second


def test_the_atlas_does_not_carry_over_where_files_disagree_or_it_does_not_fit(tmp_path):
    left(tmp_path, "sub-01", ABC)
    left(tmp_path, "sub-02", BOTH)
    left(tmp_path, "sub-03", PMC)
    found = {item.subject: item for item in find(tmp_path)}
    assert found["01"].protocol.name == "ashsABC3T"
    assert found["02"].problem is not None
    assert found["02"].problem.reason == "ambiguous-atlas"
    assert found["03"].protocol.name == "ashsPMC"


def test_the_atlas_does_not_carry_over_between_datasets(tmp_path):
    left(tmp_path, "sub-01", ABC)
    save_values(tmp_path / "derivatives" / "other" / "sub-02" / f"x_left_{GRAY}", BOTH)
    _, second = find(tmp_path)
    assert second.problem is not None


def test_a_large_dataset_is_sampled_not_read(tmp_path, monkeypatch):
    for index in range(40):
        left(tmp_path, f"sub-{index:02d}", ABC)
    opened = []
    monkeypatch.setattr(ashs, "label_values", lambda path: opened.append(path) or frozenset(ABC))
    items = find(tmp_path)
    assert len(items) == 40
    assert {item.protocol.name for item in items} == {"ashsABC3T"}
    assert 0 < len(opened) <= 16
    assert "8 other files of the dataset" in items[1].explanation


def test_an_unreadable_file_is_its_own_problem(tmp_path):
    touch(folder(tmp_path, "sub-02"), f"x_left_{GRAY}")
    alone = only(tmp_path)
    assert alone.problem is not None
    assert alone.problem.reason == "unreadable-image"
    # With the atlas known from others it is not opened here; reading it will fail.
    left(tmp_path, "sub-01", ABC)
    first, second = find(tmp_path)
    assert first.problem is None
    assert second.protocol.name == "ashsABC3T"


def test_a_huge_header_is_the_problem_of_one_hemisphere(tmp_path):
    path = save_values(folder(tmp_path, "sub-02") / f"x_left_{GRAY}", ABC)
    content = bytearray(gzip.decompress(path.read_bytes()))
    content[42:48] = np.array([32767] * 3, "<i2").tobytes()
    path.write_bytes(gzip.compress(bytes(content)))
    assert only(tmp_path).problem.reason == "image-too-large"
    left(tmp_path, "sub-01", ABC)
    assert find(tmp_path)[0].problem is None


@pytest.mark.parametrize("place", ["sub-01/final", "sub-01", ".", "snap"])
def test_snaplabels_beside_or_above_the_file_decides(tmp_path, place):
    left(tmp_path)
    table = tmp_path / "derivatives" / "ashs" / place / "snaplabels.txt"
    table.parent.mkdir(exist_ok=True)
    table.write_text(SNAP, encoding="utf-8")
    item = only(tmp_path)
    assert item.protocol.name == "ashsPMC"
    assert "snaplabels.txt" in item.explanation


def test_a_dseg_table_decides(tmp_path):
    left(tmp_path)
    rows = ["index\tname", "1\tCA1", "2\tCA2", "3\tDG", "4\tCA3", "8\tSUB", "9\tERC"]
    (tmp_path / "derivatives" / "ashs" / "dseg.tsv").write_text("\n".join(rows), encoding="utf-8")
    assert only(tmp_path).protocol.name == "ashsABC3T"


def test_a_table_of_another_atlas_makes_its_own_protocol(tmp_path):
    left(tmp_path, values=[1, 2, 3])
    text = '1 255 0 0 1 1 1 "subiculum"\n2 0 255 0 1 1 1 "CA1"\n3 0 0 255 1 1 1 "CA2/3"\n'
    (folder(tmp_path) / "snaplabels.txt").write_text(text, encoding="utf-8")
    item = only(tmp_path)
    assert item.protocol.name == "ashsCustom"
    assert [label.color for label in item.protocol.labels] == ["#ff0000", "#00ff00", "#0000ff"]


def test_a_table_without_labels_is_a_problem_not_a_guess(tmp_path):
    left(tmp_path, values=ABC)
    (folder(tmp_path) / "snaplabels.txt").write_text("nothing\n", encoding="utf-8")
    item = only(tmp_path)
    assert item.problem is not None
    assert item.problem.reason == "unreadable-table"


def test_a_users_protocol_describes_other_atlases(tmp_path):
    describe(tmp_path / "derivatives" / "ashs", "ashs")
    left(tmp_path, values=[1, 2])
    protocol = tmp_path / "mine.toml"
    protocol.write_text(
        'name = "mine"\ntitle = "t"\ncitation = "c"\nsheet = ["subiculum", "CA1"]\nlayer = []\n'
        "interior = []\nlabels = [\n"
        '{ code = 1, tissue = "CA1", name = "a", abbreviation = "a", color = "#000000" },\n'
        '{ code = 2, tissue = "subiculum", name = "b", abbreviation = "b", color = "#000000" },\n'
        "]\n",
        encoding="utf-8",
    )
    # --scheme is for files without a protocol of their own; ASHS's have an option of their own.
    assert only(tmp_path, protocol=protocol).problem is not None
    assert only(tmp_path, ashs_atlas=str(protocol)).protocol.name == "mine"
    # It says nothing of how to tell the hemispheres apart.
    save_values(folder(tmp_path, "sub-02") / f"x_{GRAY}", [1, 2])
    problems = [
        item.problem for item in find(tmp_path, ashs_atlas=str(protocol)) if item.subject == "02"
    ]
    assert [problem.reason for problem in problems] == ["unknown-hemisphere"] * 2
