"""Whole runs in the container: as nobody known, with a read-only root and without network."""

import shutil
import subprocess
import time

import pytest
from container_runs import (
    IMAGE,
    LOCKED,
    ROOT,
    USER,
    contents,
    differences,
    in_container,
    mount,
    on_data,
    outside,
    run,
    statuses,
)

from hipsta_bids.errors import ExitCode

if not IMAGE:
    pytest.skip("needs a container image: run tools/test-container", allow_module_level=True)

COBRALAB = (ROOT.parent / "shared" / "data" / "cobralab").resolve()
SIGTERM = 143


def ended(done, code=ExitCode.OK):
    """Tell whether a run ended as it should; a warning on stderr is a defect."""
    return (done.returncode, done.stderr if code == ExitCode.OK else "") == (code, "")


def test_participant_level(participants):
    _, done = participants
    assert ended(done), done
    assert "24 hemispheres: 24 ok\n" in done.stdout


def test_group_level(both_levels):
    out, done = both_levels
    assert ended(done), done
    assert list(out.glob("group/*/figures/*.png"))


def test_files_are_those_of_a_run_outside(both_levels, phantoms, reference):
    assert len(reference) > 600
    assert differences(contents(both_levels[0], phantoms), reference) == []


def test_files_belong_to_the_caller(both_levels):
    owners = {(path.stat().st_uid, path.stat().st_gid) for path in both_levels[0].rglob("*")}
    assert owners == {(USER, USER)}


def test_second_run_skips_what_is_done(participants, phantoms):
    done = on_data(phantoms, participants[0], "participant")
    assert ended(done), done
    assert "24 unchanged, skipped" in done.stdout


def test_failing_hemisphere(damaged, out):
    done = on_data(damaged, out, "participant")
    assert ended(done, ExitCode.SOME_FAILED), done
    assert done.stderr.count("\n") == 1
    assert statuses(out) == [("L", "ok"), ("R", "failed")]


def test_no_input(damaged, out):
    shutil.rmtree(damaged / "derivatives" / "freesurfer" / "sub-01")
    done = on_data(damaged, out, "participant")
    assert ended(done, ExitCode.NOTHING_TO_DO), done
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("how", ["mounted read-only", "of somebody else", "not mounted"])
def test_unwritable_output(damaged, out, how):
    if how == "of somebody else":
        out.chmod(0o755)
    flags = ("ro",) if how == "mounted read-only" else ()
    mounts = () if how == "not mounted" else mount(out, "/out", *flags)
    options = (*mount(damaged, "/data", "ro"), *mounts)
    done = in_container("/data", "/out", "participant", options=options)
    assert ended(done, ExitCode.NOT_WRITABLE), done
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("level", ["participant", "group"])
def test_no_folder_for_temporary_files(damaged, out, level):
    locks = LOCKED[: LOCKED.index("--tmpfs")]
    options = (*mount(damaged, "/data", "ro"), *mount(out, "/out"))
    done = in_container("/data", "/out", level, options=options, locks=locks)
    assert ended(done, ExitCode.NOT_WRITABLE), done
    assert "mount one at /tmp" in done.stderr
    assert done.stderr.count("\n") == 1


def test_stopped_by_docker_then_completed(damaged, out):
    options = (*mount(damaged, "/data", "ro"), *mount(out, "/out"))
    name = f"hipsta-bids-{out.parent.name}-{time.time_ns()}"
    command = ["docker", "run", "--rm", "--name", name, *LOCKED, *options, IMAGE, "/data", "/out"]
    with subprocess.Popen(
        [*map(str, command), "participant", "--n-procs", "1"], stdout=subprocess.PIPE, text=True
    ) as process:
        process.stdout.readline()
        run("docker", "stop", name)
        process.communicate()
    assert process.returncode == SIGTERM
    done = on_data(damaged, out, "participant")
    assert statuses(out) == [("L", "ok"), ("R", "failed")], done


@pytest.mark.skipif(not COBRALAB.is_dir(), reason="no shared test data beside the clone")
def test_real_labels(tmp_path, out):
    done = on_data(COBRALAB, out, "participant")
    own = tmp_path / "own"
    outside(COBRALAB, own, "participant")
    assert ended(done), done
    assert len(statuses(out)) > 1
    assert differences(contents(out, COBRALAB), contents(own, COBRALAB)) == []
