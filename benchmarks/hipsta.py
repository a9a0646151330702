"""Compare with Hipsta, the program of Diers et al. (2023): cost, failures, errors, agreement.

Draws eight phantoms, whose thickness is known, and rewrites the labels of a BIDS dataset if one is
given. Runs Hipsta, and ``hipsta-bids`` with both of its methods, on the same label files, each
in a process with one thread::

    .venv/bin/python benchmarks/hipsta.py [BIDS_DIR] --hipsta COMMAND --work DIR --tables DIR

``COMMAND`` takes the options of ``run_hipsta``. It needs the FreeSurfer commands that Hipsta
calls. A run whose result is in ``--work`` already is not repeated. The tables have a row per
hemisphere and program, and a row per kind of labels and program.
"""

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
import pandas as pd
from report import describe_machine
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import KDTree
from specimens import SIDES, Drawing, Specimen, specimens

from hipsta_bids.io import files
from hipsta_bids.phantom import Phantom
from hipsta_bids.types import Float
from validation.report import describe

HIPSTA = "hipsta"
#: Programs by name in the tables; the others are values of ``--method``.
PROGRAMS = (HIPSTA, "published", "default")
MIDDLE = 5
"""Layer of Hipsta's grid, of 11, that is the mid-surface."""
WALL = 0.9
"""Share of the wall along which Hipsta measures: from z = -0.9 to 0.9 of -1 to 1, by default."""
EDGE = 2
"""Columns beside the medial and the lateral edge that are not counted as inside."""
REACH = 1.5
"""mm; nodes of two mid-surfaces that are farther apart are not compared."""
REFINE = 4
"""Points per step of the grid on which the other program's mid-surface is searched."""
LIMIT = 900.0
"""CPU s per run."""
PATIENCE = 20

#: Columns that are averaged over hemispheres.
MEANS = (
    "bias, mm",
    "SD, mm",
    "bias inside, mm",
    "SD inside, mm",
    "bias as written, mm",
    "outermost columns, mm",
    "true there, mm",
    "minus Hipsta, mm",
    "r with Hipsta",
    "minus Hipsta inside, mm",
    "r with Hipsta inside",
)
COLUMNS = (
    *("hemisphere", "labels", "voxel, mm", "noise, mm", "program", "result", "reason"),
    *(
        "CPU s",
        "CPU s of measuring",
        "peak memory, MB",
        "true mean, mm",
        "mean, mm",
        "nodes without value",
    ),
    *MEANS,
)
#: Decimals of columns of numbers; 3 in others.
DIGITS = {
    "CPU s": 1,
    "CPU s of measuring": 1,
    "median CPU s": 1,
    "median CPU s of measuring": 1,
    "largest CPU s": 1,
} | dict.fromkeys(("peak memory, MB", "largest memory, MB", "nodes without value"), 0)
#: Texts of the tables, as those of a validation suite.
TITLE = "Beside Hipsta"
QUESTION = "Hipsta and this package, measured on the same label files"
TEXT = """\
Hipsta is the program of Diers et al. (2023). It and both methods of `hipsta-bids` measure the
same files with their defaults: phantoms, whose thickness is known, and manual labels. CPU time
and memory are those of the whole command, pages included; memory is the largest of one process.
"""
TITLES = {"hemispheres": "By hemisphere and program", "summary": "By labels and program"}
NOTES = f"""\
Hipsta's thickness spans nine tenths of the wall (z from -{WALL:g} to {WALL:g} of -1 to 1), and is
divided by {WALL:g} here; *as written* is not. Inside: without {EDGE} columns beside each edge;
outermost: the first and the last column. The truth is that at the place of each node. Compared
with Hipsta: our thickness at the place of our mid-surface nearest to each of its nodes; r only of
walls that vary. The summary has medians and means of hemispheres with a map.
"""

#: Starts a command and writes what it cost. A process counts the memory of the one that starts it
#: as its largest, so this one is small.
STARTER = """
import json, os, subprocess, sys
process = subprocess.Popen(sys.argv[2:])
_, status, usage = os.wait4(process.pid, 0)
cost = [status, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e6]
open(sys.argv[1], "w").write(json.dumps(cost))
"""
THREADS = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMEXPR")}


@dataclass(frozen=True, kw_only=True)
class Run:
    """What a run of a program cost, and how it ended."""

    cpu: float
    """s, of the process and the processes that it started."""
    memory: float
    """MB, largest that was resident at once in one process."""
    failure: str | None
    """None if there is a map."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Map:
    """Thickness on a grid; x runs medial to lateral, y posterior to anterior."""

    thickness: Float
    """(Nx, Ny) mm, NaN where there is none."""
    points: Float
    """(Nx, Ny, 3) of the mid-surface, scanner RAS mm."""


def run(command: Sequence[str], folder: Path, limit: float) -> Run:
    """Run a command, which is ended after ``limit`` CPU s; its words go to ``folder``/log.txt.

    A process that waits instead of working is ended after ``PATIENCE`` times the limit.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cost, shell = folder / "cost.json", ("/bin/sh", "-c", f'ulimit -t {limit:.0f}; exec "$@"', "sh")
    cost.unlink(missing_ok=True)
    with (folder / "log.txt").open("wb") as log:
        process = subprocess.Popen(  # noqa: S603  (the user's)
            [sys.executable, "-S", "-c", STARTER, str(cost), *shell, *command],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ | THREADS,
            start_new_session=True,
        )
        timer = threading.Timer(PATIENCE * limit, os.killpg, (process.pid, signal.SIGKILL))
        timer.start()
        process.wait()
        timer.cancel()
    killed = [signal.SIGKILL, limit, np.nan]  # for it waited
    status, cpu, memory = json.loads(cost.read_text("utf-8")) if cost.exists() else killed
    code = os.waitstatus_to_exitcode(int(status))
    failure = None
    if code in (-signal.SIGKILL, -signal.SIGXCPU):
        failure = f"no result after {limit:.0f} CPU s"
    elif code != 0:
        failure = last_error((folder / "log.txt").read_text("utf-8", "replace"), code)
    return Run(cpu=cpu, memory=memory, failure=failure)


def last_error(log: str, code: int) -> str:
    """Return the last line that names an error, without its class, or the exit code."""
    errors = re.findall(r"^(?:\w+\.)*\w*(?:Error|Exception): *(.*)$", log, re.MULTILINE)
    named = [error for error in errors if error]
    return named[-1] if named else f"exit code {code}"


def cached(file: Path, command: Sequence[str], limit: float) -> Run:
    """Run a command, or return what it cost when it was run before."""
    if not file.exists():
        result = run(command, file.parent, limit)
        file.write_text(json.dumps(asdict(result)) + "\n", encoding="utf-8")
    return Run(**json.loads(file.read_text(encoding="utf-8")))


def read_image(file: Path) -> nib.MGHImage:
    """Read an MGH image."""
    return nib.MGHImage.from_filename(file)


def read_hipsta(folder: Path, hemi: str) -> Map:
    """Read Hipsta's thickness, and its mid-surface, which is in FreeSurfer's surface space."""
    side = SIDES[hemi]
    table = pd.read_csv(folder / "thickness" / f"{side}.grid-segments-z.csv", index_col=0)
    lines = pd.read_csv(folder / "thickness" / f"{side}.grid-lines.csv", header=None).to_numpy()
    header = read_image(folder / f"{side}.image.mgz").header
    scanner = header.get_vox2ras() @ np.linalg.inv(header.get_vox2ras_tkr())
    middle = lines[lines[:, 2] == MIDDLE]
    points = np.full((*table.shape, 3), np.nan)
    points[tuple(middle[:, :2].astype(int).T)] = nib.affines.apply_affine(scanner, middle[:, 3:])
    return Map(thickness=table.to_numpy(dtype=np.float64), points=points)


def read_ours(folder: Path, specimen: Specimen) -> Map:
    """Read the table of a sheet that ``hipsta-bids`` wrote."""
    (file,) = folder.glob(f"sub-{specimen.subject}/anat/*_desc-sheet_morph.tsv")
    table = pd.read_csv(file, sep="\t", na_values="n/a")
    shape = table["x"].max(), table["y"].max()
    thickness = np.full(shape, np.nan)
    points = np.full((*shape, 3), np.nan)
    at = table["x"] - 1, table["y"] - 1
    thickness[at] = table["thickness"]
    points[at] = table[["r", "a", "s"]]
    return Map(thickness=thickness, points=points)


def command_of(program: str, hipsta: str, item: Specimen, folder: Path) -> list[str]:
    """Return the command by which a program measures a hemisphere, with its defaults."""
    if program == HIPSTA:
        options = ["--filename", str(item.labels), "--hemi", SIDES[item.hemi]]
        return [hipsta, *options, "--lut", "freesurfer", "--outputdir", str(folder)]
    package = [sys.executable, "-m", "hipsta_bids.cli.main"]
    return [*package, str(item.dataset), str(folder), "participant", "--method", program]


def measure(item: Specimen, hipsta: str, work: Path, limit: float) -> Iterator[dict[str, Any]]:
    """Measure a hemisphere with all programs; a row of the table for each."""
    costs, maps = dict[str, Run](), dict[str, Map]()
    for program in PROGRAMS:
        folder = work / "results" / item.name / program
        command = command_of(program, hipsta, item, folder)
        costs[program] = cost = cached(folder / "run.json", command, limit)
        print(f"{item.name}, {program}: {cost.cpu:.0f} CPU s, {cost.failure or 'done'}", flush=True)
        if cost.failure is None:
            read = read_hipsta(folder, item.hemi) if program == HIPSTA else read_ours(folder, item)
            maps[program] = read
    voxel = np.linalg.norm(read_image(item.labels).affine[:3, :3], axis=0).max()
    for program, cost in costs.items():
        yield {
            "hemisphere": item.name,
            "labels": "phantom" if item.drawing else "manual",
            "voxel, mm": voxel,
            "noise, mm": item.drawing.rough if item.drawing else np.nan,
            "program": program,
            "result": "map" if program in maps else "failed",
            "reason": cost.failure,
            "CPU s": cost.cpu,
            "CPU s of measuring": measuring(work / "results" / item.name / program),
            "peak memory, MB": cost.memory,
            **compare(program, item.drawing, maps),
        }


def measuring(folder: Path) -> float:
    """Return what ``hipsta-bids`` reports for the hemisphere alone, CPU s; NaN for Hipsta."""
    status = folder / "status.tsv"
    if not status.exists():
        return float("nan")
    return float(pd.read_csv(status, sep="\t", na_values="n/a")["cpu_seconds"].sum())


def compare(program: str, drawing: Drawing | None, maps: Mapping[str, Map]) -> dict[str, float]:
    """Compare a program's map with the truth of a phantom, and with Hipsta's map; mm."""
    if program not in maps:
        return {}
    points, thickness = maps[program].points, whole_wall(program, maps[program])
    row = {
        "mean, mm": mean(thickness),
        "nodes without value": float(np.isnan(thickness).sum()),
        "outermost columns, mm": mean(outermost(thickness)),
    }
    if drawing:
        truth = true_thickness(drawing, points)
        error = thickness - truth
        row |= {
            "true mean, mm": mean(truth),
            "bias, mm": mean(error),
            "SD, mm": float(np.nanstd(error)),
            "bias inside, mm": mean(inside(error)),
            "SD inside, mm": float(np.nanstd(inside(error))),
            "bias as written, mm": mean(maps[program].thickness - truth),
            "true there, mm": mean(outermost(truth)),
        }
    if program != HIPSTA and HIPSTA in maps:
        peer = whole_wall(HIPSTA, maps[HIPSTA])
        here = nearest_thickness(maps[program], maps[HIPSTA].points)
        row |= {
            "minus Hipsta, mm": mean(here - peer),
            "minus Hipsta inside, mm": mean(inside(here - peer)),
        }
        if drawing is None or drawing.spec.variation:  # r of a constant wall is that of errors
            row |= {
                "r with Hipsta": correlation(here, peer),
                "r with Hipsta inside": correlation(inside(here), inside(peer)),
            }
    return row


def mean(values: Float) -> float:
    """Return the mean of the values that are known."""
    return float(np.nanmean(values))


def inside(values: Float) -> Float:
    """Return a map (Nx, Ny) without the columns beside its medial and its lateral edge."""
    return values[EDGE:-EDGE]


def whole_wall(program: str, source: Map) -> Float:
    """Return thickness from wall to wall, (Nx, Ny) mm."""
    return source.thickness / WALL if program == HIPSTA else source.thickness


def outermost(values: Float) -> Float:
    """Return the medial and the lateral column of a map, (2, Ny)."""
    return values[[0, -1]]


def true_thickness(drawing: Drawing, points: Float) -> Float:
    """Return a phantom's thickness beside points (Nx, Ny, 3); NaN beyond its edges."""
    phantom = Phantom(drawing.spec)
    place = phantom.body.locate(points.reshape(-1, 3), hemi=drawing.hemi, pose=drawing.pose)
    u, v, _ = place.reshape(points.shape).transpose(2, 0, 1)
    inside = np.isfinite(u)
    truth = phantom.body.thickness(np.where(inside, u, 0.5), np.where(inside, v, 0.5))
    return np.where(inside, truth, np.nan)


def nearest_thickness(source: Map, points: Float) -> Float:
    """Return the thickness of a map at the places of its mid-surface nearest to points.

    NaN where the mid-surface is farther away than ``REACH``.
    """
    nx, ny = source.thickness.shape
    grid = np.arange(nx), np.arange(ny)
    fine = np.meshgrid(
        *(np.linspace(0, n - 1, REFINE * (n - 1) + 1) for n in (nx, ny)), indexing="ij"
    )
    at = np.stack(fine, axis=-1).reshape(-1, 2)
    surface, thickness = (
        RegularGridInterpolator(grid, values)(at) for values in (source.points, source.thickness)
    )
    known = np.isfinite(surface).all(axis=1) & np.isfinite(thickness)
    wanted = np.isfinite(points).all(axis=-1)
    distance, nearest = KDTree(surface[known]).query(points[wanted])
    result = np.full(points.shape[:2], np.nan)
    result[wanted] = np.where(distance <= REACH, thickness[known][nearest], np.nan)
    return result


def correlation(first: Float, second: Float) -> float:
    """Return Pearson's r over nodes that both maps have."""
    known = np.isfinite(first) & np.isfinite(second)
    return float(np.corrcoef(first[known], second[known])[0, 1])


def summarize(table: pd.DataFrame) -> pd.DataFrame:
    """Summarize the rows of each kind of labels and program; failed ones are counted alone."""
    rows = []
    for (labels, program), every in table.groupby(["labels", "program"], sort=False):
        group = every[every["result"] != "failed"]
        rows.append(
            {
                "labels": labels,
                "program": program,
                "hemispheres": len(every),
                "failed": len(every) - len(group),
                "median CPU s": group["CPU s"].median(),
                "largest CPU s": group["CPU s"].max(),
                "median CPU s of measuring": group["CPU s of measuring"].median(),
                "largest memory, MB": group["peak memory, MB"].max(),
                **{name: group[name].mean() for name in MEANS},
                "smallest r with Hipsta": group["r with Hipsta"].min(),
            }
        )
    return pd.DataFrame(rows)


def spell(name: str, value: Any) -> str:  # noqa: ANN401  (a cell)
    """Write a cell of a column."""
    if value is None or value != value:  # noqa: PLR0124  (NaN)
        return files.MISSING
    return f"{value:.{DIGITS.get(name, 3)}f}" if isinstance(value, float) else str(value)


def peer_version(command: str) -> str:
    """Ask Hipsta for its version."""
    done = subprocess.run(  # noqa: S603  (the user's)
        [command, "--version"], capture_output=True, text=True, check=False
    )
    words = re.findall(r"\d+\.\d[\w.]*", done.stdout)
    return words[-1] if words and done.returncode == 0 else files.MISSING


def write_tables(folder: Path, tables: Mapping[str, pd.DataFrame], command: str, peer: str) -> None:
    """Write tables as tab-separated values, and their texts as the record of a suite."""
    entries = []
    for name, table in tables.items():
        columns = [str(column) for column in table]
        cells = [[spell(c, row[c]) for c in columns] for row in table.to_dict("records")]
        file = f"beside-hipsta--{name}.tsv"
        files.write_tsv(folder / file, columns, cells)
        entries.append({"file": file, "title": TITLES[name], "notes": NOTES.strip()})
    about = describe_machine()
    record = {
        "title": TITLE,
        "question": QUESTION,
        "text": f"{TEXT}Machine: {about['processor']}.",
        "tables": entries,
        "figures": [],
        **describe("beside-hipsta", command),
        "libraries": {"python": about["python"], "Hipsta": peer, **about["versions"]},
    }
    files.write_json(folder / "beside-hipsta.json", record)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("bids_dir", type=Path, nargs="?", help="default: phantoms alone")
    parser.add_argument("--hipsta", required=True, metavar="COMMAND")
    parser.add_argument(
        "--work", type=Path, required=True, metavar="DIR", help="labels and results"
    )
    parser.add_argument("--tables", type=Path, required=True, metavar="DIR")
    parser.add_argument("--limit", type=float, default=LIMIT, metavar="S", help="CPU s per run")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    for item in specimens(options.bids_dir, options.work):
        rows += measure(item, options.hipsta, options.work, options.limit)
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    command = "benchmarks/hipsta.py BIDS_DIR --hipsta COMMAND --work DIR --tables DIR"
    tables = {"hemispheres": table, "summary": summarize(table)}
    write_tables(options.tables, tables, command, peer_version(options.hipsta))


if __name__ == "__main__":
    main()
