"""What Apptainer does differently from Docker, done with Docker.

The caller's own number, which no file in the image knows; a read-only root; the caller's home,
working folder and ``/tmp`` from the host; and the caller's environment, made for the host's
programs.
"""

import os
import shutil

import pytest
from container_runs import (
    IMAGE,
    PYTHON,
    contents,
    differences,
    in_container,
    mount,
    shared_folder,
)

if not IMAGE:
    pytest.skip("needs a container image: run tools/test-container", allow_module_level=True)

CALLER = 1_890_001_234  # as directory services give them
LOCKS = ("--user", f"{CALLER}:{CALLER}", "--read-only", "--network", "none")

TRAP = "raise SystemExit('a package of the host was imported')\n"
#: What a caller's environment may hold. No such folder is in the container.
ENVIRONMENT = {
    "PYTHONPATH": "/people/caller/packages",
    "PYTHONHOME": "/sw/python/3.9",
    "PYTHONUSERBASE": "/people/caller/.local",
    "PYTHONSTARTUP": "/people/caller/.pythonrc",
    "PYTHONWARNINGS": "error",
    "MPLBACKEND": "QtAgg",
    "MPLCONFIGDIR": "/scratch/caller/matplotlib",
    "XDG_CACHE_HOME": "/scratch/caller/cache",
    "TMPDIR": "/scratch/caller/job.1234",
    "DISPLAY": ":0",
    "LANG": "de_DE.ISO-8859-1",
    "LC_ALL": "de_DE.ISO-8859-1",
    "OMP_NUM_THREADS": "64",
    "OPENBLAS_NUM_THREADS": "64",
}

DRAW = """
import os
from hipsta_bids.reports.maps import new_figure
new_figure((2, 2), "constrained").savefig(os.devnull, format="png")
"""


@pytest.fixture
def home(tmp_path):
    """A home with packages of the host's Python, and settings for its programs."""
    home = shared_folder(tmp_path / "home")
    for folder in ("packages", ".local/lib/python3.11/site-packages"):
        for package in ("numpy", "nibabel", "tetgen"):
            (home / folder).mkdir(parents=True, exist_ok=True)
            (home / folder / f"{package}.py").write_text(TRAP)
    (home / ".pythonrc").write_text(TRAP)
    (home / ".config" / "matplotlib").mkdir(parents=True)
    (home / ".config" / "matplotlib" / "matplotlibrc").write_text("backend: none\nfont.size: 99\n")
    return home


def as_apptainer(home, *arguments, options=()):
    """Run in the home, with the host's folder for temporary files."""
    scratch = home.parent / "tmp"
    scratch.mkdir(exist_ok=True)
    scratch.chmod(0o1777)
    flags = [flag for name, value in ENVIRONMENT.items() for flag in ("--env", f"{name}={value}")]
    places = (*mount(home, "/people/caller"), *mount(scratch, "/tmp"))  # noqa: S108  (in the container)
    options = (*flags, "--env", "HOME=/people/caller", *places, *options)
    return in_container(*arguments, options=("--workdir", "/people/caller", *options), locks=LOCKS)


def test_both_levels_in_the_callers_home(participants, phantoms, reference, home):
    """Folders are relative to the home. One hemisphere is measured again, the rest is there."""
    out = home / "out"
    shutil.copytree(participants[0], out, ignore=shutil.ignore_patterns("group", "logs"))
    for path in (out, *out.rglob("*")):
        os.chmod(path, 0o777)  # noqa: PTH101, S103  (the container's user has to add to them)
    (next(out.glob("sub-01/anat/*hemi-L*_desc-qc_metrics.json"))).unlink()
    data = mount(phantoms, "/people/caller/data", "ro")
    for level in ("participant", "group"):
        done = as_apptainer(home, "data", "out", level, options=data)
        assert (done.returncode, done.stderr) == (0, ""), done
    found = contents(out, phantoms)
    # They name the folders or the command, here with relative paths.
    namers = ("dataset_description.json", "analysis.json", ".html")
    named = {name for name in found if name.endswith(namers)}
    assert set(differences(found, reference)) <= named
    assert list((home.parent / "tmp").iterdir()) == []


@pytest.mark.parametrize(
    "where", ["/people/nobody", "/", ""], ids=["missing", "read-only", "empty"]
)
def test_homes_that_cannot_be_used(damaged, out, where):
    options = ("--env", f"HOME={where}", "--tmpfs", "/tmp")  # noqa: S108  (in the container)
    mounts = (*mount(damaged, "/data", "ro"), *mount(out, "/out"))
    run = ("/data", "/out", "participant", "--hemi", "L")
    done = in_container(*run, options=(*options, *mounts), locks=LOCKS)
    assert (done.returncode, done.stderr) == (0, "")
    drawn = in_container("-I", "-c", DRAW, options=("--entrypoint", PYTHON, *options), locks=LOCKS)
    assert (drawn.returncode, drawn.stderr) == (0, "")
