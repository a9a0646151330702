"""What goes wrong on real machines, done for real: kills, full disks, lost inputs, odd clocks.

After each fault the same command is run again, and has to give the files of a run without any, byte
for byte. In between, every hemisphere has to be either whole or not there.
"""

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import psutil
from checks import (
    COMMAND,
    demand,
    demand_equal,
    echo,
    hipsta,
    outputs,
    phantoms,
    status,
)

_PAGE = 4096  # B
_NO_SPACE = 73

#: Loaded by every Python process that has its folder on the path: the clock jumps by up to a year.
_JUMPING_CLOCK = """
import random, time
_true = time.time
time.time = lambda: _true() + random.uniform(-3e7, 3e7)
"""


def start(data: Path, out: Path, *options: str) -> "subprocess.Popen[str]":
    """Start a run of the participant level."""
    return subprocess.Popen(  # noqa: S603  (ours)
        [*COMMAND, str(data), str(out), "participant", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def demand_whole(out: Path, reference: dict[str, bytes], what: str) -> None:
    """Say that each hemisphere with a record that it is done has all files, as they should be."""
    wrong = []
    for record in out.rglob("*_desc-qc_metrics.json"):
        if json.loads(record.read_text(encoding="utf-8"))["decision"] == "failed":
            continue
        prefix = str(record.relative_to(out).parent / record.name.partition("_seg-")[0])
        wrong += [
            name
            for name, content in reference.items()
            if name.startswith(prefix)
            and (not (out / name).exists() or (out / name).read_bytes() != content)
        ]
    if wrong:
        demand(claim=False, text=f"{what}: hemispheres are whole; these are not: {wrong[:5]}")


def check_kills(work: Path, data: Path, reference: dict[str, bytes], n_kills: int) -> None:
    """Kill the run or a process that measures at random moments."""
    generator = random.Random(0)  # noqa: S311  (no secret)
    begin = time.monotonic()
    hipsta(data, work / "timed", "participant", "--n-procs", 2)
    duration = time.monotonic() - begin
    killed = {"run": 0, "worker": 0}
    for number in range(n_kills):
        out = work / f"kill-{number}"
        victim = generator.choice(sorted(killed))
        main = start(data, out, "--n-procs", "2")
        time.sleep(generator.uniform(0, duration))
        worker = None if victim == "run" else worker_of(main.pid, generator)
        with contextlib.suppress(ProcessLookupError):
            os.kill(worker or main.pid, signal.SIGKILL)
            killed["run" if worker is None else victim] += 1
        main.communicate()
        demand_whole(out, reference, f"kill {number} ({victim})")
        if (out / "status.tsv").exists():
            known = {"n/a", "not-finished", "worker-died"}
            rows = status(out)
            unknown = {row["reason"] for row in rows if row["decision"] == "failed"} - known
            demand(not unknown, f"kill {number} ({victim}): {len(rows)} rows in status.tsv")
        hipsta(data, out, "participant", "--n-procs", 2)
        demand_equal(out, reference, f"kill {number} ({victim}), then run again")
        demand(not list(out.rglob("*.tmp")), f"kill {number}: nothing left aside")
        shutil.rmtree(out)
    echo(f"killed: {killed}")


def worker_of(pid: int, generator: random.Random) -> int | None:
    """Choose a child of a process."""
    try:
        children = psutil.Process(pid).children()
    except psutil.Error:
        return None
    return generator.choice(children).pid if children else None


def check_full_disk(work: Path, data: Path, reference: dict[str, bytes]) -> None:
    """Write to a file system that is too small, then make it larger."""
    disk = work / "disk"
    disk.mkdir()
    needed = sum(-(-len(content) // _PAGE) * _PAGE for content in reference.values())
    mount = ["mount", "-t", "tmpfs", "-o", f"size={needed * 6 // 10}", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:  # noqa: S603  (ours)
        echo("SKIPPED: full disk (mounting takes root)")
        return
    try:
        out = disk  # as deep as the reference: the description names the labels relative to it
        said = hipsta(data, out, "participant", code=_NO_SPACE)
        demand("no space left" in said, "full disk: exit code 73, and one line says why")
        demand_whole(out, reference, "full disk")
        demand(not list(out.rglob("*.tmp")), "full disk: nothing left aside")
        larger = ["mount", "-o", "remount,size=100m", str(disk)]
        subprocess.run(larger, check=True)  # noqa: S603  (ours)
        hipsta(data, out, "participant")
        demand_equal(out, reference, "full disk, then room, then run again")
    finally:
        subprocess.run(["umount", str(disk)], check=True)  # noqa: S603, S607  (ours)


def check_lost_input(work: Path, data: Path, reference: dict[str, bytes]) -> None:
    """Take the inputs away while a run is at them, then give them back."""
    out, away = work / "lost", work / "away"
    main = start(data, out, "--n-procs", "1")
    wait_for_result(main)
    data.rename(away)
    main.communicate()
    away.rename(data)
    demand(main.returncode == 1, "input vanishes: exit code 1")
    rows = status(out)
    lost = [row for row in rows if row["decision"] == "failed"]
    done = [row for row in rows if row["decision"] != "failed"]
    whys = sorted({row["reason"] for row in lost})
    demand(bool(lost and done), f"input vanishes: {len(done)} done, {len(lost)} failed ({whys})")
    demand("internal-error" not in whys, "input vanishes: no internal error")
    hipsta(data, out, "participant")
    demand_equal(out, reference, "input is back, run again")


def wait_for_result(main: "subprocess.Popen[str]") -> None:
    """Wait until a run has a result."""
    if main.stdout is None:
        raise AssertionError
    while not main.stdout.readline().startswith("sub-"):
        pass


def check_two_runs(work: Path, data: Path, reference: dict[str, bytes]) -> None:
    """Start two runs into one folder, three times."""
    for number in range(3):
        out = work / f"two-{number}"
        runs = [start(data, out, "--n-procs", "1") for _ in range(2)]
        said = [run.communicate()[0] for run in runs]
        codes = [run.returncode for run in runs]
        demand(codes == [0, 0], f"two runs into one folder: exit codes {codes}")
        measured = sum(line.startswith("sub-") for text in said for line in text.splitlines())
        demand(measured == len(status(out)), f"together they measured {measured}, each once")
        demand_equal(out, reference, "two runs into one folder")


def check_places(work: Path, data: Path, reference: dict[str, bytes]) -> None:
    """Run with odd locales, time zones and clocks, and with times of files far off."""
    clock = work / "clock"
    clock.mkdir()
    (clock / "sitecustomize.py").write_text(_JUMPING_CLOCK, encoding="utf-8")
    path = os.pathsep.join(filter(None, [str(clock), os.environ.get("PYTHONPATH")]))
    cases = {
        "Turkish": {"LC_ALL": "tr_TR.UTF-8", "LANG": "tr_TR.UTF-8"},
        "C": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        "German": {"LC_ALL": "de_DE.UTF-8", "LANG": "de_DE.UTF-8"},
        "time zone": {"TZ": "Pacific/Kiritimati"},
        "jumping clock": {"PYTHONPATH": path},
    }
    known = subprocess.run(["locale", "-a"], capture_output=True, text=True, check=False).stdout  # noqa: S607  (where it is differs)
    for name, environment in cases.items():
        wanted = environment.get("LC_ALL", "C").partition(".")[0]
        note = "" if wanted in known else f" (this machine has no {wanted})"
        # Not in ASCII, with the letter that has no capital of its own in Turkish.
        out = work / f"out-ıİß-{name}"
        hipsta(data, out, "participant", environment=environment)
        demand_equal(out, reference, f"{name}{note}")
        hipsta(data, out, "participant", environment=environment)
        demand_equal(out, reference, f"{name}, run again")
    with far_times(data):
        hipsta(data, work / "far", "participant")
        demand_equal(work / "far", reference, "inputs from 2060 and 1971")


@contextlib.contextmanager
def far_times(data: Path) -> Iterator[None]:
    """Give files times far in the future and in the past."""
    files = [path for path in data.rglob("*") if path.is_file()]
    before = [path.stat().st_mtime for path in files]
    for number, path in enumerate(files):
        os.utime(path, (2.84e9, 2.84e9) if number % 2 else (3.2e7, 3.2e7))
    try:
        yield
    finally:
        for path, seconds in zip(files, before, strict=True):
            os.utime(path, (seconds, seconds))


def check_discovery(n_subjects: int) -> None:
    """Find many subjects in two sources."""
    benchmark = Path(__file__).resolve().parents[1] / "benchmarks" / "discovery.py"
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, str(benchmark), "--n-subjects", str(n_subjects)]
        subprocess.run([*command, "--json", str(report)], check=True)  # noqa: S603  (ours)
        first = json.loads(report.read_text(encoding="utf-8"))["runs"][0]
    seconds, memory = first["seconds"], first["memory_mb"]
    demand(
        seconds < 60 and memory < 1000,  # noqa: PLR2004  (what was asked for)
        f"{n_subjects} subjects x 2 sources found in {seconds:.1f} s and {memory:.0f} MB",
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="tools/test-faults", description=__doc__)
    parser.add_argument("--kills", type=int, default=20, metavar="N")
    parser.add_argument("--n-subjects", type=int, default=2, metavar="N", help="to be measured")
    parser.add_argument("--stubs", type=int, default=10_000, metavar="N", help="to be found")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="hipsta-faults-") as folder:
        work = Path(folder)
        data = phantoms(work / "data", options.n_subjects)
        hipsta(data, work / "reference", "participant")
        reference = outputs(work / "reference")
        check_discovery(options.stubs)
        check_two_runs(work, data, reference)
        check_full_disk(work, data, reference)
        check_lost_input(work, data, reference)
        check_places(work, data, reference)
        check_kills(work, data, reference, options.kills)
    echo("all well")


if __name__ == "__main__":
    main()
