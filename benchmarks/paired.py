"""CPU time and peak memory of each command beside those of an earlier commit, in turns."""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from report import print_table, write_report

ROOT = Path(__file__).resolve().parents[1]
COMMAND = ("-m", "hipsta_bids.cli.main")
PATHS = "import sys, pathlib; a, *b = map(pathlib.Path, sys.argv[1:]); "
FIND = f"{PATHS}import hipsta_bids.inputs.search as s; s.find_inputs(s.InputRequest(bids_dir=a))"
STUBS = f"{PATHS}import discovery; discovery.write_stubs(a, int(str(b[0])))"
STUDY = f"{PATHS}import group; group.write_study(a, b[0], *map(int, str(b[1]).split('x')))"
N_SUBJECTS, TURNS = 10_000, 3


def list_commands(work: Path, options: argparse.Namespace) -> dict[str, tuple[str, ...]]:
    """Prepare data in ``work``; return arguments of Python by title. ``OUT`` is a new folder."""
    phantoms, stubs = work / "phantoms", work / "stubs"
    run(ROOT, (*COMMAND, "phantom", str(phantoms), "--n-subjects", "2"))
    run(ROOT, ("-c", STUBS, str(stubs), str(N_SUBJECTS)))
    measure = (*COMMAND, str(phantoms), "OUT", "participant")
    commands = {"start": (*COMMAND, "--version"), "first run": measure, "phantoms": measure}
    if options.bids_dir:
        commands["BIDS_DIR"] = (*COMMAND, str(options.bids_dir.resolve()), "OUT", "participant")
    commands[f"find {N_SUBJECTS} x 2"] = ("-c", FIND, str(stubs))
    for size in options.sizes:
        study = f"{work}/bids-{size}", f"{work}/results-{size}"
        run(ROOT, ("-c", STUDY, *study, size))
        further = ("--longitudinal",) if "x" in size else ()
        commands[f"group {size}"] = (*COMMAND, *study, "group", *further)
    return commands


def run(tree: Path, arguments: Sequence[str], *, compile_all: bool = False) -> tuple[float, float]:
    """Run Python in a checkout; return CPU time of all its processes, s, and peak memory, MB."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, *(a.replace("OUT", f"{folder}/out") for a in arguments)]
        environment = os.environ | {"PYTHONPATH": f"{tree}:{tree}/benchmarks"}
        environment |= {"PYTHONPYCACHEPREFIX": f"{folder}/compiled"} if compile_all else {}
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, cwd=tree, env=environment)  # noqa: S603
        _, process.returncode, used = os.wait4(process.pid, 0)
    return used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e6


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bids_dir", type=Path, nargs="?", help="real labels, measured as well")
    parser.add_argument("--baseline", required=True, metavar="COMMIT")
    parser.add_argument("--sizes", nargs="*", default=("40", "500", "40x4"), metavar="N[xVISITS]")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    rows = dict[str, list[float]]()
    with tempfile.TemporaryDirectory() as folder:
        commands, before = list_commands(Path(folder), options), Path(folder) / "baseline"
        worktree = ("git", "-C", str(ROOT), "worktree")
        subprocess.run([*worktree, "add", "-q", "--detach", before, options.baseline], check=True)  # noqa: S603
        try:
            for title, command in commands.items():
                fresh, trees = title == "first run", (before, ROOT)
                turns = [
                    [run(tree, command, compile_all=fresh) for tree in trees] for _ in range(TURNS)
                ]
                cpu, memory = ([[pair[n][k] for pair in turns] for n in (0, 1)] for k in (0, 1))
                ratio = statistics.median(now / earlier for earlier, now in zip(*cpu, strict=True))
                rows[title] = [*map(statistics.median, cpu), ratio, *map(max, memory)]
        finally:
            subprocess.run([*worktree, "remove", "--force", before], check=True)  # noqa: S603
    print_table(["CPU s, MB", "before", "now", "ratio", "MB before", "MB now"], rows)
    if options.json:
        write_report(options.json, {"baseline": options.baseline, "rows": rows})


if __name__ == "__main__":
    main()
