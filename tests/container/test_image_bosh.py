"""The descriptors launch the image that they name, by the real ``bosh``."""

import shutil

import pytest
from bosh_cases import launch, outputs_missing, read_descriptor
from container_runs import IMAGE, contents, differences

if not IMAGE:
    pytest.skip("needs a container image: run tools/test-container", allow_module_level=True)

DOCKER = ("--user", "--no-pull", "--container-opts", "--read-only --network none --tmpfs /tmp")


@pytest.fixture
def folder(phantoms, participants, tmp_path):
    """A working folder as of a platform: data and earlier results lie in it."""
    if read_descriptor("hipsta_bids")["container-image"]["image"] != IMAGE:
        pytest.skip("the descriptors name another image than IMAGE")
    shutil.copytree(phantoms, tmp_path / "data")
    shutil.copytree(participants[0], tmp_path / "out", ignore=shutil.ignore_patterns("group"))
    return tmp_path


@pytest.mark.parametrize("descriptor", ["hipsta_bids", "hipsta_bids_participant"])
def test_participant_level_by_bosh(folder, reference, descriptor):
    shutil.rmtree(folder / "out")
    level = {"analysis_level": "participant"} if descriptor == "hipsta_bids" else {}
    chosen = {"participant_label": ["01"], "n_procs": 1}
    names = {"bids_dir": "data", "output_dir": "out"}
    done = launch(folder, descriptor, how=DOCKER, **names, **level, **chosen)
    assert "Exit code\n0\n" in done.stdout, done.stdout
    assert outputs_missing(done) == ""
    found = contents(folder / "out", folder / "data")
    same = {name for name in reference if name.startswith("sub-01/")}
    assert len(same) > 20
    assert not same & set(differences(found, reference))


def test_group_level_by_bosh(folder, reference):
    done = launch(folder, "hipsta_bids_group", how=DOCKER, bids_dir="data", output_dir="out")
    assert "Exit code\n0\n" in done.stdout, done.stdout
    assert outputs_missing(done) == ""
    found = contents(folder / "out", folder / "data")
    same = {name for name in reference if name.startswith("group/")}
    assert len(same) > 20
    differing = same & set(differences(found, reference))
    # The record and the page say the command, which names folders.
    assert all(name.endswith(("/analysis.json", ".html")) for name in differing), differing
