"""Decisions and ratings by group: counts, tests, and what is reported."""

import json

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from small_cohorts import place_of, read_participants, table, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.outliers import SIZE, TEXT
from hipsta_bids.group.cohort.quality import exact_p, quality_notes, quality_table
from hipsta_bids.io import files

FAST = ("--align", "none", "--measures", "thickness", "--no-classification", "--no-reports")


def hemispheres(failed_cn, failed_ad, n=40):
    """Rows of both sides of n participants a group, of whom some fail on the left."""
    rows = []
    for group, failed in (("CN", failed_cn), ("AD", failed_ad)):
        for i in range(n):
            for side in "LR":
                decision = "failed" if side == "L" and i < failed else "use"
                rows.append([f"sub-{group}{i}", side, decision, "unrated", None, group])
    columns = ["participant_id", "side", "decision", "rating", "outlier status", "group"]
    return pd.DataFrame(rows, columns=columns)


def test_counts_and_test_are_of_participants():
    result = quality_table(hemispheres(2, 12), "group")
    assert set(result["field"]) == {"decision"}, "ratings do not vary"
    counts = result.set_index(["value", "group"])
    assert counts.loc[("failed", "AD"), "participants"] == 12
    assert counts.loc[("failed", "AD"), "hemispheres"] == 12
    assert counts.loc[("use", "CN"), "participants"] == 38
    assert counts.loc[("use", "CN"), "hemispheres"] == 78
    expected = stats.fisher_exact([[2, 12], [38, 28]]).pvalue
    np.testing.assert_allclose(result["p"], expected)
    (note,) = quality_notes(result)
    assert "the decision differs between groups" in note
    assert "failed AD 12, CN 2" in note


def test_words_that_are_no_decision_do_not_count():
    rows = hemispheres(2, 12)
    rows.loc[rows.index[-1], "decision"] = "None"
    counts = quality_table(rows, "group").set_index(["value", "group"])["hemispheres"]
    assert counts["use", "AD"] == 67
    assert counts["failed", "AD"] == 12


def test_no_note_without_a_difference():
    assert list(quality_notes(quality_table(hemispheres(3, 4), "group"))) == []
    assert not len(quality_table(hemispheres(0, 0), "group"))
    assert not len(quality_table(pd.DataFrame(), "group")), "maps of other programs alone"


def test_false_alarms():
    """Of 300 cohorts with equal rates, fewer than 5 % give a note: the test is conservative."""
    random = np.random.default_rng(0)
    alarms = [
        len(list(quality_notes(quality_table(hemispheres(*random.binomial(40, 0.15, 2)), "group"))))
        for _ in range(300)
    ]
    assert sum(alarms) <= 15


def test_outliers_that_differ_between_groups_are_noted_and_excluded(tmp_path):
    data, out = write_dataset(tmp_path)
    participants = read_participants(data)
    patients = [row[0] for row in participants if row[1] == "AD"][:7]
    identity = ("participant_id", "session_id", "hemi", "protocol", "region")
    rows = [
        (name, "n/a", hemi, "demo", "body", "0.50", text if name in patients else "n/a")
        for name, *_ in participants
        for hemi, text in (("L", "thickness 0.50 mm above"), ("R", "n/a"))
    ]
    files.write_tsv(out / "measures.tsv", (*identity, SIZE, TEXT), rows)
    options = [str(data), str(out), "group", *FAST, "--exclude-outliers", "--name"]
    assert main([*options, "q"]) == 0
    folder = out / "group" / "q"
    excluded = table(folder / "excluded.tsv")
    assert set(excluded.participant_id) == set(patients)
    assert set(excluded.hemi) == {"L"}
    assert set(excluded.reason) == {"outlier"}
    counts = table(folder / "quality.tsv").set_index(["field", "value", "group"])["participants"]
    assert counts["outlier status", "yes", "AD"] == 7
    assert counts["outlier status", "yes", "CN"] == 0
    notes = json.loads((folder / "analysis.json").read_text())["notes"]
    assert any("the outlier status differs between groups" in note for note in notes)
    assert not any("not compared" in note for note in notes)
    (out / "measures.tsv").unlink()
    assert main([*options, "without"]) == 0
    notes = json.loads((out / "group" / "without" / "analysis.json").read_text())["notes"]
    assert any(f"{len(rows)} hemispheres were not compared" in note for note in notes)


@pytest.mark.parametrize("counts", [[[5, 1], [2, 9]], [[5, 1, 3], [2, 9, 1]]])
def test_exact_p(counts):
    p = exact_p(np.array(counts))
    assert 0 < p < 0.2
    assert p == exact_p(np.array(counts)), "simulation has a seed"


def test_participants_without_any_sheet_count(tmp_path):
    data, out = write_dataset(tmp_path)
    patients = [row[0] for row in read_participants(data) if row[1] == "AD"]
    for name in patients[:7]:
        for hemi in "LR":
            path = place_of(out, name.removeprefix("sub-"), hemi).path("qc")
            record = json.loads(path.read_text()) | {"decision": "failed", "reason": "mesh"}
            path.write_text(json.dumps(record))
    assert main([str(data), str(out), "group", "--name", "q", *FAST]) == 0
    result = table(out / "group" / "q" / "quality.tsv")
    counts = result.set_index(["value", "group"])["participants"]
    assert counts["failed", "AD"] == 7
    assert counts["failed", "CN"] == 0
    assert counts["use", "AD"] == len(patients) - 7
    record = json.loads((out / "group" / "q" / "analysis.json").read_text())
    assert any("the decision differs between groups" in note for note in record["notes"])
    assert files.read_json(out / "group" / "q" / "quality.json")["hemispheres"]["Description"]


def test_excluded_labels_are_listed_among_exclusions(tmp_path):
    data, out = write_dataset(tmp_path)
    options = ["--exclude-participant-label", "03", "--name", "without", *FAST]
    assert main([str(data), str(out), "group", *options]) == 0
    rows = table(out / "group" / "without" / "excluded.tsv")
    assert rows.participant_id.tolist() == ["sub-03", "sub-03"]
    assert set(rows.message) == {"--exclude-participant-label"}
    assert main([str(data), str(out), "group", "--name", "all", *FAST]) == 0
    assert not len(table(out / "group" / "all" / "excluded.tsv"))
