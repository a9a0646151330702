"""The descriptors launch the image that they name, by the real ``bosh``."""

import shutil

import pytest
from bosh_cases import launch, outputs_found, outputs_missing
from container_runs import IMAGE, contents, differences

from descriptors import DESCRIPTORS, descriptor_text

if not IMAGE:
    pytest.skip("needs a container image: run tools/test-container", allow_module_level=True)

DOCKER = ("--user", "--no-pull", "--container-opts", "--read-only --network none --tmpfs /tmp")


@pytest.fixture
def folder(phantoms, participants, tmp_path):
    """A working folder as of a platform: data and earlier results lie in it."""
    shutil.copytree(phantoms, tmp_path / "data")
    shutil.copytree(participants[0], tmp_path / "out", ignore=shutil.ignore_patterns("group"))
    return tmp_path


@pytest.fixture
def published(tmp_path):
    """Path of a descriptor that names the image as it is called here."""

    def write(name):
        path = tmp_path / f"{name}.json"
        path.write_text(descriptor_text(DESCRIPTORS[name], image=IMAGE), encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize("descriptor", ["hipsta_bids", "hipsta_bids_participant"])
def test_participant_level_by_bosh(folder, reference, published, descriptor):
    shutil.rmtree(folder / "out")
    level = {"analysis_level": "participant"} if descriptor == "hipsta_bids" else {}
    chosen = {"participant_label": ["01"], "n_procs": 1}
    names = {"bids_dir": "data", "output_dir": "out"}
    done = launch(folder, published(descriptor), how=DOCKER, **names, **level, **chosen)
    assert "Exit code\n0\n" in done.stdout, done.stdout
    assert outputs_missing(done) == ""
    found = contents(folder / "out", folder / "data")
    same = {name for name in reference if name.startswith("sub-01/")}
    assert len(same) > 20
    assert not same & set(differences(found, reference))


@pytest.mark.parametrize("descriptor", ["hipsta_bids", "hipsta_bids_participant"])
def test_dry_run_by_bosh(folder, published, descriptor):
    level = {"analysis_level": "participant"} if descriptor == "hipsta_bids" else {}
    names = {"bids_dir": "data", "output_dir": "new"}
    done = launch(folder, published(descriptor), how=DOCKER, **names, **level, dry_run=True)
    assert "Exit code\n0\n" in done.stdout, done.stdout
    assert "sub-01" in done.stdout
    assert outputs_missing(done) == ""
    assert outputs_found(done) <= {"output_dataset"}


@pytest.mark.parametrize("descriptor", ["hipsta_bids", "hipsta_bids_group"])
def test_group_level_by_bosh(folder, reference, published, descriptor):
    level = {"analysis_level": "group"} if descriptor == "hipsta_bids" else {}
    names = {"bids_dir": "data", "output_dir": "out"}
    done = launch(folder, published(descriptor), how=DOCKER, **names, **level)
    assert "Exit code\n0\n" in done.stdout, done.stdout
    assert outputs_missing(done) == ""
    found = contents(folder / "out", folder / "data")
    same = {name for name in reference if name.startswith("group/")}
    assert len(same) > 20
    differing = same & set(differences(found, reference))
    # The record and the page say the command, which names folders.
    assert all(name.endswith(("/analysis.json", ".html")) for name in differing), differing
