"""Whole runs in the container: as nobody known, with a read-only root and without network."""

import json
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

from hipsta_bids.derivatives.dataset import CODE_URL_VARIABLE, CONTAINER_VARIABLES
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
    assert "24 hemispheres: 24 use\n" in done.stdout


def test_group_level(both_levels):
    out, done = both_levels
    assert ended(done), done
    kinds = {path.suffix for path in out.glob("group/*/figures/thickness_maps.*")}
    assert kinds == {".pdf", ".png", ".svg"}


def test_files_are_those_of_a_run_outside(both_levels, phantoms, reference):
    assert len(reference) > 600
    assert differences(contents(both_levels[0], phantoms), reference) == []


def test_datasets_name_the_image_that_made_them(both_levels, out, damaged):
    """The default is the name that it was built by; it is that of a registry with ``-e``."""
    text = (both_levels[0] / "dataset_description.json").read_text(encoding="utf-8")
    maker = json.loads(text)["GeneratedBy"][0]
    assert maker["Container"] == {"Type": "docker", "Tag": IMAGE}
    names = {CONTAINER_VARIABLES["Tag"]: "lab/hipsta_bids:1", CODE_URL_VARIABLE: "https://a.org/b"}
    flags = [flag for name, value in names.items() for flag in ("--env", f"{name}={value}")]
    done = on_data(damaged, out, "participant", "--hemi", "L", options=flags)
    assert ended(done), done
    text = (out / "dataset_description.json").read_text(encoding="utf-8")
    maker = json.loads(text)["GeneratedBy"][0]
    assert maker["Container"] == {"Type": "docker", "Tag": "lab/hipsta_bids:1"}
    assert maker["CodeURL"] == "https://a.org/b"


def test_default_user(damaged, out):
    """Without ``-u`` results belong to the image's user, who is not root."""
    mounts = (*mount(damaged, "/data", "ro"), *mount(out, "/out"))
    locks = LOCKED[2:]  # but for the user
    done = in_container("/data", "/out", "participant", "--hemi", "L", options=mounts, locks=locks)
    assert ended(done), done
    assert {path.stat().st_uid for path in out.rglob("*")} == {1000}
    out.chmod(0o755)
    refused = in_container("/data", "/out", "participant", options=mounts, locks=locks)
    assert ended(refused, ExitCode.NOT_WRITABLE), refused
    assert refused.stderr.count("\n") == 1


DASK = """
dask scheduler --scheduler-file /tmp/scheduler.json --no-dashboard >/tmp/scheduler.log 2>&1 &
dask worker --scheduler-file /tmp/scheduler.json --nthreads 1 --nworkers 2 --no-dashboard \
    >/tmp/worker.log 2>&1 &
exec hipsta-bids /data /out participant --participant-label 01 --dask-scheduler /tmp/scheduler.json
"""


def test_dask_engine(phantoms, out, reference):
    """Scheduler and workers are of the image, too; the network is the container's own."""
    mounts = (*mount(phantoms, "/data", "ro"), *mount(out, "/out"))
    options = ("--init", "--entrypoint", "/bin/sh", *mounts)
    done = in_container("-c", DASK, options=options)
    assert ended(done), done
    found = contents(out, phantoms)
    same = {name for name in reference if name.startswith("sub-01/")}
    assert len(same) > 20
    assert not same & set(differences(found, reference))


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
    assert statuses(out) == [("L", "use"), ("R", "failed")]


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
    assert statuses(out) == [("L", "use"), ("R", "failed")], done


@pytest.mark.skipif(not COBRALAB.is_dir(), reason="no shared test data beside the clone")
def test_real_labels(tmp_path, out):
    done = on_data(COBRALAB, out, "participant")
    own = tmp_path / "own"
    outside(COBRALAB, own, "participant")
    assert ended(done), done
    assert len(statuses(out)) > 1
    assert differences(contents(out, COBRALAB), contents(own, COBRALAB)) == []
