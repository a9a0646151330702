"""What is in the image, and how fast it starts."""

import json
import os
import re
import time

import pytest
from container_runs import (
    IMAGE,
    PYTHON,
    ROOT,
    first_line_of,
    in_container,
    mount,
    run,
    shared_folder,
)

from descriptors import descriptor_text
from hipsta_bids import __version__
from hipsta_bids.derivatives.dataset import CODE_URL_VARIABLE, CONTAINER_VARIABLES

if not IMAGE:
    pytest.skip("needs a container image: run tools/test-container", allow_module_level=True)

UNCOMPILED = """
import sys, sysconfig
from importlib.util import cache_from_source
from pathlib import Path

paths = sysconfig.get_paths()
others = {"site-packages", "dist-packages", "test", "tests", "lib2to3"}
files = [*Path(paths["purelib"]).rglob("*.py")]
files += [p for p in Path(paths["stdlib"]).rglob("*.py") if not others & set(p.parts)]
print(len(files) > 4000, [p for p in files if not Path(cache_from_source(p)).exists()])
"""

LEFT_OVERS = r"""
find / -xdev -path /proc -prune -o -type f -perm -100 \
    \( -name 'gcc*' -o -name 'g++*' -o -name 'cc1*' -o -name '*-ld' -o -name ld \) -print
find ~/.cache /build /program /tmp -mindepth 1 2>/dev/null
find /opt/hipsta_bids -path '*-packages/pip' -o -path '*-packages/plotly' -o -name tests \
    -o -name '*.whl' -o -name '*.a' -o -name '*.h'
true
"""


#: Tools may rewrite such files, and damage what they do not understand.
UNLOADABLE = """
import ctypes, sys, sysconfig
from pathlib import Path

import numpy, scipy, PIL.Image  # they say where their libraries are
site = Path(sysconfig.get_path("purelib"))
files = [path for path in site.rglob("*.so*") if path.is_file()]
bad = []
for path in files:
    try:
        ctypes.CDLL(str(path))
    except OSError as error:
        bad.append(f"{path.relative_to(site)}: {error}")
print(len(files) > 300, bad)
"""

#: What is known of every image. The first three are known to tools/build-image alone.
LABELS = {
    "created": r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ",
    "revision": r"[0-9a-f]{40}(-dirty)?",
    "base.digest": r"sha256:[0-9a-f]{64}",
    "base.name": r".+",
    "title": r"hipsta_bids",
    "description": r"BIDS App .+",
    "version": re.escape(__version__),
    "authors": r".+",
    "vendor": r".+",
    "licenses": r"AGPL-3\.0-or-later",
}


def inspect(form):
    return run("docker", "image", "inspect", "--format", form, IMAGE).stdout.strip()


def environment():
    return dict(entry.split("=", 1) for entry in json.loads(inspect("{{json .Config.Env}}")))


def test_size_is_below_target(record_figure):
    size = int(inspect("{{.Size}}"))
    record_figure(f"size {size / 1e6:.0f} MB")
    assert size < 800e6


def test_labels_are_complete():
    labels = json.loads(inspect("{{json .Config.Labels}}"))
    prefix = "org.opencontainers.image."
    known = dict(LABELS)
    if environment()[CODE_URL_VARIABLE]:
        known |= dict.fromkeys(("source", "url"), re.escape(environment()[CODE_URL_VARIABLE]))
    if not (ROOT / ".git").exists():
        del known["revision"]
    assert {key for key in labels if key.startswith(prefix)} == {prefix + key for key in known}
    wrong = {
        key: labels[prefix + key]
        for key, form in known.items()
        if not re.fullmatch(form, labels[prefix + key])
    }
    assert not wrong


def test_default_user_is_not_root():
    assert inspect("{{.Config.User}}") == "1000:1000"
    done = in_container("-c", "id -u", options=("--entrypoint", "/bin/sh"), locks=())
    assert done.stdout == "1000\n"


def test_own_code_is_a_small_layer_over_the_packages():
    """The last layer with anything in it; a change of the program leaves the others as they are."""
    form = ("--no-trunc", "--human=false", "--format", "{{.Size}} {{.CreatedBy}}")
    lines = run("docker", "history", *form, IMAGE).stdout.splitlines()
    sizes = [int(line.split()[0]) for line in lines if line.split()[0] != "0"]
    assert sizes[0] < 10e6
    assert sizes[1] > 300e6


def test_nothing_is_left_of_the_build():
    options = ("--entrypoint", "/bin/sh", "--user", "0")
    done = in_container("-c", LEFT_OVERS, options=options, locks=())
    assert (done.returncode, done.stdout) == (0, "")


def test_every_library_can_be_loaded():
    done = in_container("-I", "-c", UNLOADABLE, options=("--entrypoint", PYTHON))
    assert done.stdout == "True []\n", done


def test_no_module_is_compiled_at_run_time():
    done = in_container("-I", "-c", UNCOMPILED, options=("--entrypoint", PYTHON))
    assert done.stdout == "True []\n"


@pytest.mark.parametrize("shell_options", ["-c", "-lc"])
def test_command_is_found_by_shells(shell_options):
    """Login shells, by which platforms call, set the search path anew."""
    options = ("--entrypoint", "/bin/sh")
    done = in_container(shell_options, "hipsta-bids --version", options=options)
    assert done.stdout == f"hipsta_bids {__version__}\n"


def test_descriptor_is_the_one_in_the_repository():
    given = environment()
    published = {"image": given[CONTAINER_VARIABLES["Tag"]], "url": given[CODE_URL_VARIABLE]}
    assert published["image"] == IMAGE
    assert in_container("--bids-exec-spec").stdout.strip() == descriptor_text(**published).strip()


@pytest.fixture
def check_seconds(record_figure):
    """Compare the shortest of several durations with a limit: other work only adds to them."""

    def check(name, durations, limit):
        shortest = min(durations)
        record_figure(f"{name} {shortest:.2f} s")
        load = os.getloadavg()[0]
        if shortest >= limit and load > os.cpu_count():
            pytest.skip(f"{name} took {shortest:.2f} s on a busy machine (load {load:.0f})")
        assert shortest < limit

    return check


def test_version_within_a_second(check_seconds):
    def version():
        start = time.monotonic()
        assert in_container("--version").stdout == f"hipsta_bids {__version__}\n"
        return time.monotonic() - start

    check_seconds("--version", [version() for _ in range(5)], 1)


def test_first_line_within_two_seconds(phantoms, tmp_path, check_seconds):
    out = shared_folder(tmp_path / "out")
    options = (*mount(phantoms, "/data", "ro"), *mount(out, "/out"))
    arguments = ("/data", "/out", "participant", "--dry-run")
    seen = [first_line_of(*arguments, options=options) for _ in range(5)]
    opening = f"hipsta_bids {__version__}, participant level of /data\n"
    assert {line for line, _ in seen} == {opening}
    check_seconds("first line", [seconds for _, seconds in seen], 2)
