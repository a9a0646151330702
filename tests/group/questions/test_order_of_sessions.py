"""The first session and the order of visits: by time if known, else by numbers in names."""

import json

import numpy as np
import pandas as pd
import pytest
from extension_marks import needs
from small_cohorts import (
    FAST,
    PLAN,
    begin_dataset,
    methods_of,
    place_of,
    table,
    write_hemisphere,
    write_participants,
)

from hipsta_bids.cli.main import main
from hipsta_bids.group.cohort.covariates import order_sessions
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from validation.group import simulate_cohort

#: Thinning of the wall per visit, mm.
LOSS = 0.2


def write_visits(folder, sessions, dates=None):
    """Write visits of participants whose walls thin, in the order of ``sessions``."""
    data, out = begin_dataset(folder)
    cohort, random = simulate_cohort(PLAN, 0), np.random.default_rng(1)
    people = [f"{i + 1:02d}" for i in range(12)]
    for i, subject in enumerate(people):
        for visit, session in enumerate(sessions):
            noise = 0.01 * random.standard_normal(cohort.thickness[i].shape)
            wall = np.maximum(cohort.thickness[i] - LOSS * visit + noise, 0.1)
            place = place_of(out, subject, "L", session=session)
            write_hemisphere(place, wall, cohort.curvature[i])
        if dates is not None:
            rows = [[f"ses-{s}", date] for s, date in zip(sessions, dates, strict=True)]
            path = data / f"sub-{subject}" / f"sub-{subject}_sessions.tsv"
            files.write_tsv(path, ["session_id", "acq_time"], rows)
    rows = [[f"sub-{one}", f"{60 + i}"] for i, one in enumerate(people)]
    write_participants(data, rows, ["participant_id", "age"])
    return data, out


def run(study, *options):
    data, out = study
    # Repeatability has no classification to leave out.
    fast = [one for one in FAST if "--retest" not in options or one != "--no-classification"]
    assert main([str(data), str(out), "group", *fast, *options, "--name", "run"]) == 0
    return out / "group" / "run"


STUDIES = {
    "dates": (("pre", "post"), ("2020-03-01", "2021-03-01")),
    "numbers": (("2", "10", "11"), None),
}


@pytest.fixture(params=STUDIES)
def study(request, tmp_path):
    sessions, dates = STUDIES[request.param]
    return write_visits(tmp_path, sessions, dates), sessions


@needs("repeated")
def test_categories_are_compared_with_the_first_session(study):
    folders, sessions = study
    folder = run(folders, "--longitudinal", "visits", "--formula", "visit")
    effects = table(folder / "maps.tsv").set_index("contrast")
    assert list(effects.index) == [f"change to {name}" for name in sessions[1:]]
    for visit, name in enumerate(sessions[1:], 1):
        stem = f"hemi-L_contrast-ChangeTo{name.capitalize()}_desc-thickness_statmap.tsv"
        points = table(folder / stem)
        assert points.estimate.median() == pytest.approx(-LOSS * visit, abs=0.01)


def test_the_first_session_is_analyzed_by_default(study):
    folders, sessions = study
    folder = run(folders, "--formula", "age")
    assert set(table(folder / "covariates.tsv").session_id) == {f"ses-{sessions[0]}"}
    left_out = table(folder / "excluded.tsv")
    assert set(left_out.session_id) == {f"ses-{name}" for name in sessions[1:]}
    assert set(left_out.reason) == {"later-session"}


@needs("repeated")
def test_tables_have_visits_in_order(study):
    folders, sessions = study
    folder = run(folders, "--longitudinal", "visits", "--formula", "visit")
    visits = table(folder / "covariates.tsv")
    assert visits.session_id.tolist() == [f"ses-{name}" for name in sessions] * 12


COMMON = "All visits of a participant were measured on one sheet"


@pytest.mark.parametrize("frame", ["visit", "person", "shared"])
@pytest.mark.parametrize("options", [(), pytest.param(("--retest",), marks=needs("trials"))])
def test_methods_name_common_sheets(tmp_path, frame, options):
    folders = write_visits(tmp_path, ("1", "2"))
    path = folders[1] / "desc-settings.json"
    settings = json.loads(path.read_text())
    settings["settings"]["sheet"]["frame"] = frame
    path.write_text(json.dumps(settings))
    text = methods_of(run(folders, *(options or ("--formula", "age"))))
    assert (COMMON in text) == (frame != "visit")


def ordered(rows, **columns):
    table = pd.DataFrame([row.split() for row in rows], columns=["participant_id", "session_id"])
    return order_sessions(table.astype(object).assign(**columns), GroupSettings())


def test_the_median_time_decides():
    rows = [f"sub-{n} ses-{name}" for n in (1, 2, 3) for name in ("a", "b")]
    dates = ["2021", "2020", "2021", "2020", "2020", "2021"]
    assert ordered(rows, acq_time=dates) == ["ses-b", "ses-a"]
    # A participant with one session is always at time 0.
    single = [f"sub-{n} ses-a" for n in range(4, 9)]
    assert ordered(rows + single, acq_time=dates + ["2021"] * 5) == ["ses-b", "ses-a"]
    assert ordered(rows, months=["12", "0"] * 3) == ["ses-b", "ses-a"]


def test_names_decide_unless_all_sessions_have_times():
    rows = [f"sub-1 ses-{name}" for name in ("10", "2", "m24", "m6")]
    natural = ["ses-2", "ses-10", "ses-m6", "ses-m24"]
    assert ordered(rows) == natural
    assert ordered(rows, acq_time=["2020", "2021", None, "2019"]) == natural
    assert ordered(rows, acq_time=["2020", "2021", "later", "2019"]) == natural
    assert ordered(rows, acq_time=["2020", "2021", "2018", "2019"]) == [
        *("ses-m24", "ses-m6", "ses-10", "ses-2")
    ]
