"""Runs that several tests look at. They begin in the container, and the same outside of it."""

import shutil

import pytest
from container_runs import contents, on_data, outside, shared_folder

FIGURES = pytest.StashKey[list[str]]()
N_PROCS = ("--n-procs", "2")


@pytest.fixture(scope="session")
def phantoms(tmp_path_factory):
    """Six controls and six patients: about the fewest that the default model takes."""
    data = tmp_path_factory.mktemp("phantoms") / "bids"
    outside("phantom", data, "--n-subjects", "12")
    return data


@pytest.fixture(scope="session")
def reference(phantoms, tmp_path_factory):
    """Results of both levels outside of the container."""
    out = tmp_path_factory.mktemp("outside") / "out"
    outside(phantoms, out, "participant", *N_PROCS)
    outside(phantoms, out, "group")
    return contents(out, phantoms)


@pytest.fixture(scope="session")
def participants(phantoms, tmp_path_factory):
    """Folder and end of the participant level in the container."""
    out = shared_folder(tmp_path_factory.mktemp("inside") / "out")
    return out, on_data(phantoms, out, "participant", *N_PROCS)


@pytest.fixture(scope="session")
def both_levels(phantoms, participants):
    """Folder, and the end of the group level after the participant level."""
    out, _ = participants
    return out, on_data(phantoms, out, "group")


@pytest.fixture
def out(tmp_path):
    return shared_folder(tmp_path / "out")


@pytest.fixture
def damaged(phantoms, tmp_path):
    """One hemisphere as it should be and one of which most is missing."""
    data = tmp_path / "damaged"
    folder = "derivatives/freesurfer/sub-01/mri"
    shutil.copytree(phantoms / folder, data / folder)
    shutil.copy(phantoms / "dataset_description.json", data)
    right = next((data / folder).glob("rh.*"))
    right.write_bytes(right.read_bytes()[:1000])
    return data


@pytest.fixture
def record_figure(request):
    """Takes what was measured, for the summary at the end."""
    return request.config.stash.setdefault(FIGURES, []).append


def pytest_terminal_summary(terminalreporter, config):
    for figure in config.stash.get(FIGURES, []):
        terminalreporter.write_line(f"measured: {figure}")
