"""Runs of the command, in the container image under test and outside of it."""

import csv
import io
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

from hipsta_bids.derivatives.dataset import linked_folder

ROOT = Path(__file__).parents[2]

IMAGE = os.environ.get("HIPSTA_BIDS_IMAGE", "")
"""Name of the image; without one nothing of this is tested."""

USER = 12345
"""Nobody whom the image or the host knows."""

LOCKED = (
    *("--user", f"{USER}:{USER}", "--read-only", "--network", "none"),
    *("--tmpfs", "/tmp"),  # noqa: S108  (the container's own)
)

PYTHON = "/opt/hipsta_bids/bin/python"
"""The interpreter in the image."""

_CLOCKS = ("seconds", "cpu_seconds", "peak_memory")
_OF_THE_IMAGE = ("Container", "CodeURL")


def run(*command, **options):
    """Run a program to its end."""
    return subprocess.run(
        [*map(str, command)], capture_output=True, text=True, check=False, **options
    )


def mount(folder, target, *flags):
    return ("--volume", ":".join([str(folder), target, *flags]))


def shared_folder(folder):
    """Make a folder that the container's user may write to, whoever makes it."""
    folder.mkdir()
    folder.chmod(0o777)
    return folder


def in_container(*arguments, options=(), locks=LOCKED):
    """``docker run`` with the image's entry point."""
    return run("docker", "run", "--rm", *locks, *options, IMAGE, *arguments)


def on_data(data, out, *arguments, options=()):
    """Run on a dataset that the container cannot change."""
    mounts = (*mount(data, "/data", "ro"), *mount(out, "/out"))
    return in_container("/data", "/out", *arguments, options=(*mounts, *options))


def first_line_of(*arguments, options=()):
    """First line that the program prints, and how long after the start of ``docker run``, s."""
    command = ["docker", "run", "--rm", *LOCKED, *options, IMAGE, *arguments]
    start = time.monotonic()
    with subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, text=True) as process:
        line = process.stdout.readline()
        seconds = time.monotonic() - start
        process.communicate()
    return line, seconds


def outside(*arguments):
    """Run this checkout in this environment, which is made from the same lock."""
    done = run(sys.executable, "-m", "hipsta_bids.cli.main", *arguments)
    assert done.returncode == 0, done.stderr
    return done


def contents(out, data):
    """Bytes of all results by path, but for logs, times, the folders' names and the container's."""
    names = {str(data): "/data", str(out): "/out"}
    return {
        str(path.relative_to(out)): _impersonal(path, names)
        for path in sorted(out.rglob("*"))
        if path.is_file()
        and path.suffix != ".parquet"  # the image has no pyarrow
        and "logs" not in path.relative_to(out).parts
    }


def _impersonal(path: Path, names):
    if path.name == "status.tsv":
        rows = csv.DictReader(io.StringIO(path.read_text(encoding="utf-8")), delimiter="\t")
        timeless = [
            {key: value for key, value in row.items() if not key.startswith(_CLOCKS)}
            for row in rows
        ]
        return sorted(timeless, key=str)
    if path.name in {"dataset_description.json", "analysis.json"} or path.suffix == ".html":
        text = path.read_text(encoding="utf-8")
        if path.name == "dataset_description.json":
            text = _anywhere(json.loads(text), path.parent)
        if path.suffix == ".html":  # the folder of the labels, in commands
            text = re.sub(r"(?<= )(LABELS_DIR|\.\./\S*)/(?=[^/\s]+\.(mgz|nii))", "", text)
            text = re.sub(r"; LABELS_DIR stands for [^:<]*", "", text)
        for name, stand_in in names.items():
            text = text.replace(name, stand_in)
        return re.sub(r"\d{4}-\d{2}-\d{2} \d{2}:\d{2}", "TIME", text)
    return path.read_bytes()


def _anywhere(description, root):
    """Text of a description without the image, with folders instead of the ways that lead there."""
    for key in _OF_THE_IMAGE:
        description["GeneratedBy"][0].pop(key, None)
    links = description["DatasetLinks"].items()
    folders = {name: os.path.normpath(linked_folder(link, root)) for name, link in links}
    sources = [source["URL"] for source in description["SourceDatasets"]]
    urls = [os.path.normpath(linked_folder(url, root)) for url in sources]
    return json.dumps(description | {"DatasetLinks": folders, "SourceDatasets": urls})


def differences(one, other):
    """Names of files that only one has, or that differ."""
    return sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))


def statuses(out):
    """Side and status of each hemisphere."""
    with (out / "status.tsv").open(encoding="utf-8", newline="") as table:
        return sorted(
            (row["hemi"], row["decision"]) for row in csv.DictReader(table, delimiter="\t")
        )
