"""Runs on a real SLURM: array jobs as docs/clusters.md has them, Dask, and workers that are lost.

Every way has to give the files of a plain run, byte for byte. SLURM is started by a program that
prints ``export SLURM_CONF=...`` when called with a folder, and stops it when called with
``--stop`` and the folder; where SLURM runs already, none is needed.
"""

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import psutil
from checks import (
    COMMAND,
    break_one,
    demand,
    demand_equal,
    echo,
    hipsta,
    outputs,
    phantoms,
    reasons,
    status,
)

ROOT = Path(__file__).resolve().parents[1]
PARTS = 3


def run(*command: str, code: int | None = 0, cwd: Path | None = None) -> str:
    """Run a program and give what it prints."""
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd)  # noqa: S603  (ours)
    if code is not None and done.returncode != code:
        sys.exit(f"FAILED: {' '.join(command)}: {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def write_scripts(folder: Path) -> None:
    """Take the batch scripts from the documentation, so that those are what is tested."""
    text = (ROOT / "docs" / "clusters.md").read_text(encoding="utf-8")
    for found in re.findall(r"```bash\n(#!.*?)```", text, re.DOTALL):
        name = re.search(r"^# (\S+\.sbatch)", found, re.MULTILINE)
        if name is not None:
            # Few subjects: no template can be made of them.
            block = found.replace('"$OUT_DIR" group', '"$OUT_DIR" group --align none')
            (folder / name[1]).write_text(block, encoding="utf-8")


def submit(work: Path, data: Path, out: Path, *options: str, wait: bool = False) -> str:
    """Submit a job as a user does; give its number, or its exit code if it is waited for."""
    os.environ |= {"BIDS_DIR": str(data), "OUT_DIR": str(out)}
    if wait:
        done = subprocess.run(  # noqa: S603  (ours)
            ["sbatch", "--wait", "--parsable", *options],  # noqa: S607  (where it is differs)
            cwd=work,
            capture_output=True,
            check=False,
        )
        return str(done.returncode)
    return run("sbatch", "--parsable", *options, cwd=work).strip()


def wait_for_jobs() -> None:
    """Wait until SLURM has nothing to do."""
    while run("squeue", "--noheader").strip():
        time.sleep(1)


def keep_columns(table: Path, n_columns: int) -> None:
    """Cut a table down: few subjects allow few covariates."""
    rows = [line.split("\t")[:n_columns] for line in table.read_text("utf-8").splitlines()]
    table.write_text("\n".join(map("\t".join, rows)) + "\n", "utf-8")


def check_array(work: Path, data: Path, reference: dict[str, bytes]) -> None:
    """Array job, then the group level after it."""
    out = work / "array"
    array = submit(work, data, out, f"--array=1-{PARTS}", "measure.sbatch")
    submit(work, data, out, f"--dependency=afterok:{array}", "group.sbatch")
    wait_for_jobs()
    demand_equal(out, reference, f"array job of {PARTS} tasks and collect")
    demand(bool(list(out.glob("group/*/methods.md"))), "group level after the array (afterok)")
    log = out / "logs"
    demand(len(list(log.glob("status_shard-*"))) == PARTS, "each task has a table of its own")


def check_failure(work: Path, data: Path) -> None:
    """Let a hemisphere fail: exit codes, a complete table, and no group level."""
    broken, out, local = work / "broken", work / "array-broken", work / "local-broken"
    shutil.copytree(data, broken)
    break_one(broken)
    hipsta(broken, local, "participant", code=1)
    code = submit(work, broken, out, f"--array=1-{PARTS}", "measure.sbatch", wait=True)
    demand(code == "1", "array with a failed hemisphere ends with 1")
    hipsta(broken, out, "collect", code=1)
    demand_equal(out, outputs(local), "array with a failed hemisphere")
    rows = status(out)
    failed = [row for row in rows if row["decision"] == "failed"]
    demand(len(failed) == 1, f"status.tsv: {len(rows)} rows, 1 failed ({failed[0]['reason']})")
    array = submit(work, broken, out, f"--array=1-{PARTS}", "measure.sbatch")
    after = (f"--dependency=afterok:{array}", "--kill-on-invalid-dep=yes", "group.sbatch")
    submit(work, broken, out, *after)
    wait_for_jobs()
    demand(not (out / "group").exists(), "no group level after a failure (afterok)")


def check_lost_task(work: Path, data: Path, reference: dict[str, bytes]) -> None:
    """Kill a task of an array: collect says so, and the task alone is done again."""
    out = work / "lost-task"
    array = submit(work, data, out, f"--array=1-{PARTS}%1", "measure.sbatch")
    wait_until(lambda: any(out.rglob("*_desc-sheet_morph.tsv")))
    run("scancel", "--signal=KILL", "--full", f"{array}_1", code=None)
    wait_for_jobs()
    hipsta(data, out, "collect", code=1)
    demand("not-finished" in reasons(out), "collect names what a killed task did not finish")
    again = (ROOT / "docs" / "clusters.md").read_text(encoding="utf-8")
    demand("--shard $SLURM_ARRAY_TASK_ID/100" in again, "the docs say how to repeat a part")
    script = (work / "measure.sbatch").read_text(encoding="utf-8")
    repeat = script.replace("--shard slurm", f"--shard $SLURM_ARRAY_TASK_ID/{PARTS}")
    (work / "repeat.sbatch").write_text(repeat, encoding="utf-8")
    submit(work, data, out, "--array=1", "repeat.sbatch", wait=True)
    hipsta(data, out, "collect")
    demand_equal(out, reference, "array with a killed task, done again")


def check_memory(work: Path, data: Path) -> None:
    """Give one job of the array too little memory: the system kills what it measures, no more."""
    out = work / "memory"
    few = submit(work, data, out, "--mem=150M", "--array=1", "repeat.sbatch", wait=True)
    enough = submit(work, data, out, f"--array=2-{PARTS}", "repeat.sbatch", wait=True)
    demand((few, enough) == ("1", "0"), "a job out of memory ends with 1, others with 0")
    hipsta(data, out, "collect", code=1)
    found = reasons(out)
    n_died, n_spared = found.count("worker-died"), found.count("n/a")
    demand(n_died > 0, f"{n_died} of {len(found)} hemispheres failed by it")
    demand(n_spared == len(found) - n_died > 0, f"{n_spared} were spared")


def check_dask(work: Path, data: Path, reference: dict[str, bytes]) -> None:
    """Workers by dask-jobqueue, left alone."""
    out = work / "dask"
    hipsta(data, out, "participant", "--slurm", "--time=20", "--n-procs", 2)
    demand_equal(out, reference, "dask-jobqueue, 2 jobs")
    wait_for_jobs()


def check_lost_workers(work: Path, data: Path, reference: dict[str, bytes]) -> None:
    """Kill a job of Dask, then a process that measures."""
    out = work / "lost-job"
    command = [*COMMAND, str(data), str(out), "participant", "--slurm", "--time=20"]
    with subprocess.Popen([*command, "--n-procs", "2"], stdout=subprocess.PIPE, text=True) as main:  # noqa: S603  (ours)
        first_result(main)
        job = run("squeue", "--noheader", "--format=%i").split()[0]
        run("scancel", "--signal=KILL", "--full", job)
        main.communicate()
    demand(main.returncode == 0, f"a job of Dask was killed ({job}), the run went on")
    demand_equal(out, reference, "dask-jobqueue with a lost job")
    wait_for_jobs()
    out = work / "lost-process"
    command[len(COMMAND) + 1] = str(out)
    with subprocess.Popen([*command, "--n-procs", "1"], stdout=subprocess.PIPE, text=True) as main:  # noqa: S603  (ours)
        first_result(main)
        os.kill(measuring_process(), signal.SIGKILL)
        main.communicate()
    found = reasons(out)
    demand(main.returncode == 1, "a process that measures was killed: exit code 1")
    demand(found.count("worker-died") == 1, f"1 of {len(found)} hemispheres failed by it")
    hipsta(data, out, "participant")
    demand_equal(out, reference, "the same, run again")
    wait_for_jobs()


def first_result(main: "subprocess.Popen[str]") -> None:
    """Wait until a run has a result."""
    if main.stdout is None:
        raise AssertionError
    while not main.stdout.readline().startswith("sub-"):
        pass


def measuring_process() -> int:
    """Find the process of a job that measures: it has TetGen as its child."""
    while True:
        for process in psutil.process_iter(["cmdline", "environ", "ppid"]):
            of_job = "SLURM_JOB_ID" in (process.info["environ"] or {})
            if of_job and "hipsta_bids.geometry.tetgen_worker" in " ".join(
                process.info["cmdline"] or []
            ):
                return int(process.info["ppid"])
        time.sleep(0.05)


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait for something to happen."""
    while not condition():
        time.sleep(0.1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="tools/test-cluster", description=__doc__)
    parser.add_argument(
        "--start-slurm",
        type=Path,
        default=os.environ.get("START_SLURM") or ROOT / ".." / "shared" / "tools" / "start-slurm",
        metavar="PROGRAM",
        help="starts SLURM (default: $START_SLURM, or ../shared/tools/start-slurm)",
    )
    parser.add_argument("--n-subjects", type=int, default=6, metavar="N")
    options = parser.parse_args(arguments)
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    with tempfile.TemporaryDirectory(prefix="hipsta-cluster-") as folder:
        work = Path(folder)
        sinfo = shutil.which("sinfo")  # starting SLURM may be what installs it
        running = False
        if sinfo:
            running = not subprocess.run([sinfo], capture_output=True, check=False).returncode  # noqa: S603
        if not running:
            for line in run(str(options.start_slurm), str(work / "slurm")).splitlines():
                name, _, value = line.removeprefix("export ").partition("=")
                os.environ[name] = value
        echo(run("sinfo", "--version").strip())
        try:
            check_all(work, options.n_subjects)
        finally:
            if not running:
                run(str(options.start_slurm), "--stop", str(work / "slurm"), code=None)
    echo("all well")


def check_all(work: Path, n_subjects: int) -> None:
    """Run everything."""
    write_scripts(work)
    data = phantoms(work / "data", n_subjects)
    keep_columns(data / "participants.tsv", 3)
    hipsta(data, work / "local", "participant")
    reference = outputs(work / "local")
    check_array(work, data, reference)
    check_failure(work, data)
    check_lost_task(work, data, reference)
    check_memory(work, data)
    check_dask(work, data, reference)
    check_lost_workers(work, data, reference)


if __name__ == "__main__":
    main()
