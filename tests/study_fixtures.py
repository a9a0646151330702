"""Small studies, and settings that keep their analysis short."""

import shutil

import numpy as np
import pytest
from small_cohorts import (
    GROUPS,
    PLAN,
    Study,
    write_dataset,
    write_participants,
    write_sessions,
)

from hipsta_bids.group.output import write
from validation.group import simulate_cohort


@pytest.fixture(scope="session")
def quick(tmp_path_factory):
    """Settings with little cross-validation, which takes most of the time."""
    path = tmp_path_factory.mktemp("settings") / "group.toml"
    path.write_text("[classification]\nrepeats = 2\nfolds = 3\n[multiplicity]\nseed = 3\n")
    return ["--settings", str(path)]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    write_dataset(folder)
    return folder


@pytest.fixture
def study(written, tmp_path):
    """A copy that may be spoiled."""
    shutil.copytree(written, tmp_path / "study")
    return Study(tmp_path / "study" / "bids", tmp_path / "study" / "out")


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Three yearly sessions; patients' wall thins by 0.1 mm per year, that of others by 0.02."""
    cohort = simulate_cohort(PLAN, 0)
    data, out = write_sessions(
        tmp_path_factory.mktemp("sessions"),
        cohort,
        np.where(cohort.group, 0.1, 0.02),
        noise=0.02,
        column="acq_time",
        times=lambda i, year: f"20{10 + year}-03-0{1 + i % 9}T12:00:00",
    )
    rows = [
        [f"sub-{i + 1:02d}", GROUPS[int(patient)], f"{age:.1f}", "MF"[int(sex)]]
        for i, (patient, age, sex) in enumerate(
            zip(cohort.group, cohort.age, cohort.sex, strict=True)
        )
    ]
    write_participants(data, rows)
    return data, out


@pytest.fixture
def without_figures(monkeypatch):
    """Leave out what takes longer than all else."""
    monkeypatch.setattr(write, "draw_figures", lambda *_: iter(()))
