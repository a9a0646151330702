"""What is in the image, and how fast it starts."""

import os
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

from hipsta_bids import __version__

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
print(len(files) > 5000, [p for p in files if not Path(cache_from_source(p)).exists()])
"""

LEFT_OVERS = r"""
find / -xdev -path /proc -prune -o -type f -perm -100 \
    \( -name 'gcc*' -o -name 'g++*' -o -name 'cc1*' -o -name '*-ld' -o -name ld \) -print
find ~/.cache /build /tmp -mindepth 1 2>/dev/null
find /opt/hipsta_bids -path '*-packages/pip' -o -path '*-packages/plotly' -o -name tests \
    -o -name '*.whl'
true
"""


def inspect(form):
    return run("docker", "image", "inspect", "--format", form, IMAGE).stdout.strip()


def test_size_is_below_target(record_figure):
    size = int(inspect("{{.Size}}"))
    record_figure(f"size {size / 1e9:.2f} GB")
    assert size < 1.2e9


def test_nothing_is_left_of_the_build():
    done = in_container("-c", LEFT_OVERS, options=("--entrypoint", "/bin/sh"), locks=())
    assert (done.returncode, done.stdout) == (0, "")


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
    expected = (ROOT / "descriptors" / "hipsta_bids.json").read_text(encoding="utf-8")
    assert in_container("--bids-exec-spec").stdout.strip() == expected.strip()


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
