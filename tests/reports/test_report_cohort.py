"""Ranges and distances, with hemispheres made up for it."""

import json

import numpy as np
import pytest

from hipsta_bids.derivatives.names import HemisphereName, name_of_record, output_name
from hipsta_bids.derivatives.results import ResultPlace
from hipsta_bids.reports.cohort import (
    MEASURES,
    SMALLEST_COMPARED,
    Cohort,
    distances,
    read_cohort,
    robust_scores,
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


def test_scores_are_those_of_a_normal_distribution_and_missing_values_stay():
    values = np.random.default_rng(0).normal(3.0, 2.0, 4001)
    # The standard error of a robust SD of 4000 values is about 2 %.
    np.testing.assert_allclose(robust_scores(values), (values - 3) / 2, atol=0.25)
    values[7] = np.nan
    scores = robust_scores(values)
    assert np.isnan(scores[7])
    assert np.isfinite(scores).sum() == 4000


def test_what_does_not_vary_has_no_distance():
    assert robust_scores(np.ones(9)).tolist() == [0.0] * 9


def test_one_who_stands_apart_is_found_and_named(tmp_path):
    rng = np.random.default_rng(1)
    usual = rng.normal(1.0, 0.01, (SMALLEST_COMPARED, len(MEASURES)))
    usual[3, 2] += 1.0
    for n, values in enumerate(usual):
        make(tmp_path, f"{n:02d}", values)
    cohort = read_cohort(tmp_path)
    found = distances(cohort, {})
    farthest = max(found, key=lambda title: found[title][0])
    assert farthest == "sub-03_hemi-L_seg-P"
    assert found[farthest][1] == list(MEASURES.values())[2]["title"]
    assert found[farthest][0] > 30  # 1.0 away where the SD is 0.01, known to a third


def test_a_map_that_differs_is_found_where_all_numbers_agree(tmp_path):
    rng = np.random.default_rng(2)
    maps = {}
    for n in range(SMALLEST_COMPARED):
        result = make(tmp_path, f"{n:02d}", rng.normal(1.0, 0.01, len(MEASURES)))
        maps[result.name.title] = rng.normal(2.0, 0.1, (5, 4))
    maps["sub-04_hemi-L_seg-P"][:2] += 1.0
    found = distances(read_cohort(tmp_path), maps)
    assert found["sub-04_hemi-L_seg-P"][1] == "Map of thickness"


def test_few_hemispheres_are_not_compared(tmp_path):
    for n in range(SMALLEST_COMPARED - 1):
        make(tmp_path, f"{n:02d}", np.arange(len(MEASURES)) + n)
    assert distances(read_cohort(tmp_path), {}) == {}


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
