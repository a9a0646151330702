"""CPU time and peak memory of each command beside those of an earlier commit, in turns."""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from discovery import write_stubs
from group import write_study
from report import print_table, write_report

ROOT = Path(__file__).resolve().parents[1]
COMMAND = ("-m", "hipsta_bids.cli.main")
FIND = """import sys, pathlib, hipsta_bids.inputs.search as s
s.find_inputs(s.InputRequest(bids_dir=pathlib.Path(sys.argv[1])))"""
N_SUBJECTS, TURNS = 10_000, 3


def list_commands(work: Path, options: argparse.Namespace) -> dict[str, tuple[str, ...]]:
    """Prepare data in ``work``; return arguments of Python by title. ``OUT`` is a new folder."""
    phantoms, stubs = work / "phantoms", work / "stubs"
    run(ROOT, (*COMMAND, "phantom", str(phantoms), "--n-subjects", "2"))
    write_stubs(stubs, N_SUBJECTS)
    measure = (*COMMAND, str(phantoms), "OUT", "participant")
    commands = {"start": (*COMMAND, "--version"), "first run": measure, "phantoms": measure}
    if options.bids_dir:
        commands["BIDS_DIR"] = (*COMMAND, str(options.bids_dir.resolve()), "OUT", "participant")
    commands[f"find {N_SUBJECTS} x 2"] = ("-c", FIND, str(stubs))
    for size in options.sizes:
        study = work / f"study-{size}"
        write_study(study / "bids", study / "out", size)
        commands[f"group {size}"] = (*COMMAND, str(study / "bids"), str(study / "out"), "group")
    return commands


def run(tree: Path, arguments: Sequence[str], *, compile_all: bool = False) -> tuple[float, float]:
    """Run Python in a checkout; return CPU time of all its processes, s, and peak memory, MB."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, *(a.replace("OUT", f"{folder}/out") for a in arguments)]
        environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": ""}
        environment |= {"PYTHONPYCACHEPREFIX": f"{folder}/compiled"} if compile_all else {}
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, cwd=tree, env=environment)  # noqa: S603
        _, process.returncode, used = os.wait4(process.pid, 0)
    return used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e6


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bids_dir", type=Path, nargs="?", help="real labels, measured as well")
    parser.add_argument("--baseline", required=True, metavar="COMMIT")
    parser.add_argument("--sizes", type=int, nargs="*", default=(40, 500), metavar="N")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    rows: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        commands, before = list_commands(Path(folder), options), Path(folder) / "baseline"
        worktree = ("git", "-C", str(ROOT), "worktree")
        subprocess.run([*worktree, "add", "-q", "--detach", before, options.baseline], check=True)  # noqa: S603
        try:
            for title, command in commands.items():
                trees, is_fresh = (before, ROOT) * TURNS, title == "first run"
                costs = [run(tree, command, compile_all=is_fresh) for tree in trees]
                cpu, memory = np.reshape(costs, (-1, 2, 2)).transpose(2, 0, 1)
                ratio = np.median(cpu[:, 1] / cpu[:, 0])
                rows[title] = [*np.median(cpu, axis=0), ratio, *memory.max(axis=0)]
        finally:
            subprocess.run([*worktree, "remove", "--force", before], check=True)  # noqa: S603
    print_table(["CPU s, MB", "before", "now", "ratio", "MB before", "MB now"], rows)
    if options.json:
        write_report(options.json, {"baseline": options.baseline, "rows": rows})


if __name__ == "__main__":
    main()
