"""Ranges and outliers, with hemispheres made up for it."""

import json
import re

import numpy as np
import pytest

from hipsta_bids.derivatives.names import HemisphereName, name_of_record, output_name
from hipsta_bids.derivatives.outliers import SIZE, TEXT
from hipsta_bids.derivatives.results import ResultPlace
from hipsta_bids.io import files
from hipsta_bids.reports.cohort import (
    MEASURES,
    Cohort,
    cohort_page,
    read_cohort,
)
from hipsta_bids.reports.results import Hemisphere, find_results


def make(root, subject, values, *, hemi="L", decision="use", **record):
    """Write the two files that a cohort is read from."""
    result = ResultPlace(
        root=root, name=HemisphereName(subject=subject, session=None, hemi=hemi, seg="P")
    )
    result.path("qc").parent.mkdir(parents=True, exist_ok=True)
    result.path("qc").write_text(json.dumps({"decision": decision, **record}))
    if decision != "failed":
        names = list(MEASURES)
        result.path("summary").write_text(
            "\t".join(names) + "\n" + "\t".join(f"{v}" for v in values) + "\n"
        )
    return result


def test_outliers_come_from_the_table_of_measures(tmp_path):
    for n in range(3):
        make(tmp_path, f"{n:02d}", np.ones(len(MEASURES)))
    text = "thickness 0.50 mm above its surroundings, unlike in the others: CA1, RAS -30 -12 4 mm"
    columns = ("participant_id", "session_id", "hemi", "protocol", "region", SIZE, TEXT)
    rows = [(f"sub-{n:02d}", "n/a", "L", "P", "body", "0.21", "n/a") for n in range(3)]
    rows[1] = (*rows[1][:5], "0.50", text)
    rows[2] = (*rows[2][:5], "n/a", "n/a")
    files.write_tsv(tmp_path / "measures.tsv", columns, rows)
    cohort = read_cohort(tmp_path)
    assert set(cohort.compared) == {"sub-00_hemi-L_seg-P", "sub-01_hemi-L_seg-P"}
    page = cohort_page(cohort)
    assert "1 outlier among hemispheres" in page
    assert f">sub-01 L</a>: {text}." in page
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1])
    cells = {row["participant"]: (row["distance"], row["farthest"]) for row in data["rows"]}
    assert cells == {"sub-00": (0.21, ""), "sub-01": (0.5, text), "sub-02": (None, "")}


def test_a_page_without_comparison_has_no_outliers(tmp_path):
    make(tmp_path, "01", np.ones(len(MEASURES)))
    page = cohort_page(read_cohort(tmp_path))
    assert "With 10 or more hemispheres" in page
    assert "Largest step" not in page


def test_failed_ones_and_other_sides_are_not_in_the_range(tmp_path):
    name = make(tmp_path, "01", np.ones(len(MEASURES))).name
    make(tmp_path, "02", np.ones(len(MEASURES)), hemi="R")
    make(tmp_path, "03", (), decision="failed")
    cohort = read_cohort(tmp_path)
    assert len(cohort.hemispheres) == 3
    assert cohort.values(name, next(iter(MEASURES))).tolist() == [1.0]


def test_damaged_records_are_left_out(tmp_path):
    make(tmp_path, "01", np.ones(len(MEASURES)))
    make(tmp_path, "02", np.ones(len(MEASURES))).path("qc").write_text("{")
    make(tmp_path, "03", np.ones(len(MEASURES))).path("summary").unlink()
    assert [h.result.name.subject for h in read_cohort(tmp_path).hemispheres] == ["01"]


def test_the_last_run_that_measured_a_hemisphere_is_its_origin(tmp_path):
    make(tmp_path, "01", np.ones(len(MEASURES)))
    logs = tmp_path / "logs"
    logs.mkdir()
    line = "2026-01-0{0} 10:00:00,123 INFO {1}\n"
    title = "sub-01_hemi-L_seg-P"
    for day, outcome in ((1, "use"), (2, "look"), (3, "unchanged, skipped (look)")):
        text = line.format(day, f"command: run {day}") + line.format(day, f"{title}: {outcome}")
        (logs / f"run-2026010{day}T100000-1.log").write_text(text)
    assert read_cohort(tmp_path).origins[title] == ("run 2", "2026-01-02 10:00")


def test_places_in_messages_are_found_and_folders_are_not_told(tmp_path):
    record = {
        "decision": "look",
        "flags": [{"reason": "a", "message": "a hole at RAS -1.5 20 3.25 mm (CA2/3): large"}],
        "repairs": ["a hole at RAS -1.5 20 3.25 mm (CA2/3)", "cut a bridge"],
        "message": "data/someone/scan.mgz: cannot be read (T1w/T2w)",
    }  # fmt: skip
    name = HemisphereName(subject="01", session=None, hemi="L", seg="P")
    hemisphere = Hemisphere(ResultPlace(root=tmp_path, name=name), record)
    assert [(f.kind, f.point) for f in hemisphere.findings] == [
        ("flag", (-1.5, 20.0, 3.25)),
        ("repair", None),
    ]
    assert "CA2/3" in hemisphere.findings[0].message
    assert hemisphere.message == "scan.mgz: cannot be read (T1w/T2w)"


@pytest.mark.parametrize("session", [None, "a"])
@pytest.mark.parametrize("region", ["body", "extended"])
def test_names_of_records_are_understood(session, region):
    name = HemisphereName(subject="01", session=session, hemi="R", seg="P", region=region)
    assert name_of_record(output_name(name, "qc")) == name
    assert name_of_record(output_name(name, "summary_sidecar")) is None


def test_results_of_one_visit_are_found_in_order(tmp_path):
    for hemi in "RL":
        make(tmp_path, "02", np.ones(len(MEASURES)), hemi=hemi)
    make(tmp_path, "01", np.ones(len(MEASURES)))
    assert [h.result.name.hemi for h in find_results(tmp_path, "02")] == ["L", "R"]
    assert isinstance(read_cohort(tmp_path), Cohort)
