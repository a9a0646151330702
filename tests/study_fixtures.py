"""Small studies, and settings that keep their analysis short."""

import shutil

import pytest
from small_cohorts import Study, write_dataset

from hipsta_bids.group.output import write


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


@pytest.fixture
def without_figures(monkeypatch):
    """Leave out what takes longer than all else."""
    monkeypatch.setattr(write, "draw_figures", lambda *_: iter(()))
