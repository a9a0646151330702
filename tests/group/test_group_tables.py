"""Tables as laboratories keep them, through the command line: each doubt costs one line."""

import pytest
from small_cohorts import FAST, read_participants, write_participants

from hipsta_bids.cli.main import main
from hipsta_bids.io import files

pytestmark = pytest.mark.usefixtures("without_figures")
COLUMNS = ("participant_id", "group", "age", "sex", "site")


def with_cells(study, changes, columns=COLUMNS):
    """Change cells of participants.tsv by row and column; sites are a, b and c."""
    rows = [
        dict(zip(COLUMNS, [*row, "abc"[k % 3]], strict=True))
        for k, row in enumerate(read_participants(study.data))
    ]
    for (row, column), cell in changes.items():
        rows[row][column] = cell
    write_participants(study.data, [list(row.values()) for row in rows], columns)


def run(study, capsys, *options):
    code = main([str(study.data), str(study.out), "group", *FAST, "--name", "t", *options])
    said = capsys.readouterr()
    assert not said.err
    assert code == 0
    folder = study.out / "group" / "t"
    return said.out, files.read_tsv(folder / "design.tsv"), files.read_tsv(folder / "excluded.tsv")


def test_missing_values_of_all_kinds_are_left_out_and_told_in_one_line(study, capsys):
    spelled = {(k, "sex"): "unknown" for k in (3, 4, 5)} | {
        (0, "age"): "-9999",
        (1, "age"): "?",
        (2, "age"): "n.a.",
        (6, "sex"): "-9",
        (7, "group"): "None",
        (20, "group"): "NA",
        (21, "group"): "-",
        (22, "site"): "NaN",
        (23, "site"): ".",
        (24, "site"): "n/a",
    }
    with_cells(study, spelled)
    said, design, excluded = run(study, capsys)
    assert list(design[0])[2:] == ["Intercept", "group[T.AD]", "age", "sex[T.M]", *SITES]
    assert sorted((row["participant_id"], row["message"]) for row in excluded) == sorted(
        (f"sub-{row + 1:02d}", f"{column} is missing") for row, column in spelled
    )
    (line,) = [line for line in said.splitlines() if "read as missing" in line]
    assert line == (
        "note: read as missing: age '-9999' (1), age '?' (1), age 'n.a.' (1), group '-' (1), group"
        " 'NA' (1), group 'None' (1), sex '-9' (1), sex 'unknown' (3) and 2 more; if one is a"
        " level, list it in Levels of the table's sidecar"
    )
    notes = files.read_json(study.out / "group" / "t" / "analysis.json")["notes"]
    assert line.removeprefix("note: ") in notes


SITES = ["site[T.b]", "site[T.c]"]


def test_spreadsheets_are_read_with_blanks_marks_and_line_ends(study, capsys):
    with_cells(study, {}, ("participant_id ", " group", "age\u00a0", "sex", "site"))
    path = study.data / "participants.tsv"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n") + b"\t\t\t\t\r\n")
    said, design, excluded = run(study, capsys)
    assert list(design[0])[2:] == ["Intercept", "group[T.AD]", "age", "sex[T.M]", *SITES]
    assert len(design) == 30
    assert not excluded
    assert "read as missing" not in said


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        (("participant_id", "group", "age", "age ", "site"), "'age' occurs more than once"),
        (("participant_id", "group", "sex", "Sex", "site"), "sex and Sex differ in capitals only"),
    ],
)
def test_columns_that_are_there_twice_are_refused(study, capsys, columns, words):
    with_cells(study, {}, columns)
    assert main([str(study.data), str(study.out), "group", *FAST]) == 65
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_participants_who_are_not_in_the_table_are_named_so(study, capsys):
    rows = read_participants(study.data)
    rows[3][2] = "n/a"
    rows[5][0] = "sub-6"
    write_participants(study.data, [*rows[:28], rows[29]])
    said, design, excluded = run(study, capsys)
    assert len(design) == 27
    assert "note: not in participants.tsv: sub-06, sub-29\n" in said
    assert {(row["participant_id"], row["reason"], row["message"]) for row in excluded} == {
        ("sub-04", "incomplete", "age is missing"),
        ("sub-06", "incomplete", "not in participants.tsv"),
        ("sub-29", "incomplete", "not in participants.tsv"),
    }
