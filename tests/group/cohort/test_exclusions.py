"""Ratings that a person saved from the report, at the group level."""

import json

import pytest
from small_cohorts import place_of, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.group.cohort.collect import GroupRequest, collect_sheets
from hipsta_bids.group.output import write
from hipsta_bids.io import files
from hipsta_bids.reports.group import write_group_report

HEADER = (
    *("participant_id", "session_id", "hemi", "protocol", "region", "rating", "note"),
    "input_hash",
)
#: Labels of sub-04 have changed since; sub-05 was rated twice; nobody is sub-77.
ROWS = (
    ("sub-01", "n/a", "L", "demo", "body", "exclude", "leak at the tail", "01L"),
    ("sub-01", "n/a", "R", "demo", "body", "use", "n/a", "01R"),
    ("sub-02", "n/a", "L", "demo", "body", "unsure", "n/a", "n/a"),
    ("sub-03", "n/a", "L", "demo", "body", "n/a", "look again", "03L"),
    ("sub-03", "n/a", "R", "demo", "extended", "exclude", "n/a", "03R"),
    ("sub-04", "n/a", "L", "demo", "body", "exclude", "n/a", "earlier"),
    ("sub-05", "n/a", "L", "demo", "body", "use", "n/a", "05L"),
    ("05", "n/a", "n/a", "n/a", "n/a", "exclude", "n/a", "n/a"),
    ("sub-77", "n/a", "L", "demo", "body", "use", "n/a", "77L"),
)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rated")
    data, out = write_dataset(folder)
    for n in range(1, 31):
        for hemi in "LR":
            path = place_of(out, f"{n:02d}", hemi).path("qc")
            record = json.loads(path.read_text())
            files.write_json(path, record | {"input_hash": f"{n:02d}{hemi}"})
    path = folder / "ratings.tsv"
    files.write_tsv(path, HEADER, ROWS)
    return data, out, path


LEFT_OUT = {("sub-01", "L"), ("sub-05", "L"), ("sub-05", "R")}


def test_ratings_leave_out_and_are_counted(study, quick, capsys, monkeypatch):
    data, out, path = study
    monkeypatch.setattr(write, "draw_figures", lambda *_: iter(()))  # they take longest
    options = [*quick, "--align", "none", "--measures", "thickness", "--name", "rated"]
    assert main([str(data), str(out), "group", *options, "--ratings", str(path)]) == 0
    told = capsys.readouterr().out
    assert f"{path}: matches no hemisphere here: sub-03, sub-77" in told
    assert "not applied to hemispheres whose labels have changed since" in told
    assert "sub-04_hemi-L; rate them again" in told
    folder = out / "group" / "rated"
    rows = [r for r in files.read_tsv(folder / "excluded.tsv") if r["reason"] == "rated"]
    assert {(r["participant_id"], r["hemi"]) for r in rows} == LEFT_OUT
    assert rows[0]["message"] == "leak at the tail"
    counts = {"use": 1, "unsure": 1, "exclude": 3, "unrated": 55}
    assert json.loads((folder / "analysis.json").read_text())["ratings"] == counts
    words = "1 use, 1 unsure, 3 exclude, 55 unrated"
    assert f"Hemispheres were rated on their report pages ({words})" in (
        folder / "methods.md"
    ).read_text().replace("\n", " ")
    assert write_group_report(out, "rated") is None
    assert words in (out / "group" / "rated.html").read_text()


def test_without_ratings_nothing_is_said_of_them(study):
    found = collect_sheets(GroupRequest(roots=(study[1],)))
    assert found.ratings is None
    assert found.notes == ()


def test_a_table_of_ratings_may_stand_for_one_of_exclusions(study):
    _, out, path = study
    found = collect_sheets(GroupRequest(roots=(out,), exclude_table=path))
    assert {(e.participant, e.hemi) for e in found.exclusions} == LEFT_OUT
    assert {e.reason for e in found.exclusions} == {"listed"}
    assert any("sub-04_hemi-L; rate them again" in note for note in found.notes)
    assert found.ratings is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "file not found"),
        ("participant_id\themi\nsub-01\tL\n", "no column rating"),
        ("hemi\trating\nL\tuse\n", "no column participant_id"),
        ("participant_id\trating\nsub-01\tuse\nsub-02\tbad\n", "line 3: 'bad' is no rating; use,"),
    ],
)
def test_unusable_ratings_are_refused_in_one_line(study, tmp_path, capsys, text, words):
    data, out, _ = study
    path = tmp_path / "ratings.tsv"
    if text is not None:
        path.write_text(text)
    assert main([str(data), str(out), "group", "--name", "no", "--ratings", str(path)]) == 65
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error
    assert not (out / "group" / "no").exists()


def test_an_empty_table_of_ratings_is_told(study, tmp_path):
    path = tmp_path / "ratings.tsv"
    path.write_text("\t".join(HEADER) + "\n")
    found = collect_sheets(GroupRequest(roots=(study[1],), ratings=path))
    assert found.notes == (f"{path}: has no rows that count; it changes nothing",)
    assert found.ratings["unrated"] == 60
