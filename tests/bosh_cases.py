"""Runs the real ``bosh`` on the descriptors, offline and with a home of its own."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import hipsta_bids

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent


def descriptor_path(name):
    """Path of a descriptor of the repository; any other is given as a path."""
    return name if isinstance(name, Path) else ROOT / "descriptors" / f"{name}.json"


def read_descriptor(name):
    return json.loads(descriptor_path(name).read_text(encoding="utf-8"))


def bosh(folder, *arguments):
    """Run ``bosh`` in a folder."""
    home = folder / "home"
    home.mkdir(exist_ok=True)
    path = os.pathsep.join([str(BIN), os.environ["PATH"]])
    package = Path(hipsta_bids.__file__).parents[1]
    python_path = os.pathsep.join([str(package), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [BIN / "bosh", *map(str, arguments)],
        cwd=folder,
        env=os.environ | {"HOME": str(home), "PATH": path, "PYTHONPATH": python_path},
        capture_output=True,
        text=True,
        check=False,
    )


def simulate(folder, descriptor, /, **invocation):
    """The command line that an invocation gives, or ``None`` if ``bosh`` refuses it."""
    done = bosh(
        folder, "exec", "simulate", descriptor_path(descriptor), "-i", _write(folder, invocation)
    )
    match = re.fullmatch(r"Generated Command:\n(.+)\n", done.stdout)
    return match[1] if match and done.returncode == 0 else None


def launch(folder, descriptor, /, *, how=("--no-container",), **invocation):
    """Run an invocation, by default without a container."""
    options = [*how, "--skip-data-collection"]
    return bosh(
        folder, "exec", "launch", *options, descriptor_path(descriptor), _write(folder, invocation)
    )


def outputs_found(done):
    """Ids of the output files that ``bosh`` has found."""
    section = done.stdout.split("Output files")[1].split("Missing files")[0]
    return set(re.findall(r"\((output_\w+), ", section))


def outputs_missing(done):
    """What ``bosh`` says of required outputs that it has not found."""
    return done.stdout.split("Missing files")[1].strip()


def _write(folder, invocation):
    path = folder / "invocation.json"
    path.write_text(json.dumps(invocation), encoding="utf-8")
    return path
