"""Small cohorts of sheets as the participant level leaves them; nothing is measured."""

import json
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from hipsta_bids import __version__
from hipsta_bids.cli.main import main
from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.hemisphere import format_column
from hipsta_bids.derivatives.names import HemisphereName
from hipsta_bids.derivatives.results import ResultPlace
from hipsta_bids.io import files
from hipsta_bids.settings import Settings, SheetSettings
from validation.group import SimulationPlan, simulate_cohort

NODES = (21, 7)
PLAN = SimulationPlan(
    sizes=(16, 14),
    nodes=NODES,
    effect=4.0,
    center=(12.0, 3.0),
    core=(1.0, 1.0),
    taper=2.0,
    shift=1.0,
    warp_sd=(0.5, 0.25),
)
SETTINGS = Settings(sheet=SheetSettings(x_nodes=NODES[0], y_nodes=NODES[1]))
COLUMNS = ["x", "y", "thickness", "curvature", "subfield"]
GROUPS = ("CN", "AD")
#: What keeps runs short that look at the model only.
FAST = ("--align", "none", "--measures", "thickness", "--no-classification", "--no-reports")


class Study(NamedTuple):
    """A BIDS dataset and the output of the participant level."""

    data: Path
    out: Path


def place_of(root, subject, hemi, *, session=None, seg="demo", region="body"):
    name = HemisphereName(subject=subject, session=session, hemi=hemi, seg=seg, region=region)
    return ResultPlace(root=root, name=name)


def write_hemisphere(place, thickness, curvature, *, volume=500.0, **record):
    """Sheet, summary and quality record of one hemisphere."""
    nx, ny = thickness.shape
    x, y = np.divmod(np.arange(nx * ny), ny)
    cells = [
        [str(i + 1) for i in x],
        [str(j + 1) for j in y],
        format_column(thickness, 4),
        format_column(curvature, 5),
        ["Sub" if i < nx // 3 else "CA1" for i in x],
    ]
    files.write_tsv(place.path("sheet"), COLUMNS, zip(*cells, strict=True))
    units = {"thickness": {"Units": "mm"}, "curvature": {"Units": "1/mm"}}
    files.write_json(place.path("sheet_sidecar"), units)
    mean = float(np.nanmean(thickness))
    row = [f"{mean:.4f}", f"{volume:.4f}", "n/a"]
    files.write_tsv(place.path("summary"), ["thickness_mean", "volume", "area_mid"], [row])
    units = {"thickness_mean": {"Units": "mm"}, "volume": {"Units": "mm^3"}}
    files.write_json(place.path("summary_sidecar"), units)
    digest = json.loads((place.root / "desc-settings.json").read_text())["hash"]
    content = {
        "decision": "use",
        "settings_hash": digest,
        "version": __version__,
        "inputs": [{"file": f"bids:fs:sub-{place.name.subject}/mri/labels.mgz"}],
        "metrics": {"filled_fraction": 0.0, "rule": "labels"},
    }
    files.write_json(place.path("qc"), content | record)


def begin_dataset(folder):
    """Folders of a BIDS dataset and of the participant level's output, which has no hemispheres."""
    data, out = folder / "bids", folder / "out"
    out.mkdir(parents=True)
    dataset.settle_settings(out, SETTINGS)
    dataset.write_description(out, {"fs": folder / "fs"})
    return data, out


def write_sessions(folder, cohort, losses, *, noise, column, times, lacking=()):
    """Three yearly sessions, in which walls thin by ``losses`` (participants,) mm per year.

    ``times(i, year)`` is a participant's value of a column of sessions.tsv.
    """
    data, out = begin_dataset(folder)
    random = np.random.default_rng(0)
    for i, loss in enumerate(losses):
        subject, rows = f"{i + 1:02d}", []
        for year, session in enumerate("123"):
            if (i, session) in lacking:
                continue
            for hemi in "LR":
                wall = cohort.thickness[i] - loss * year + noise * random.standard_normal(NODES)
                wall = np.maximum(wall, 0.1)
                bend = cohort.curvature[i] + 0.01 * random.standard_normal(NODES)
                place = place_of(out, subject, hemi, session=session)
                volume = 500 + 3 * i - 5 * year + random.random()
                write_hemisphere(place, wall, bend, volume=volume)
            rows.append([f"ses-{session}", times(i, year)])
        path = data / f"sub-{subject}" / f"sub-{subject}_sessions.tsv"
        files.write_tsv(path, ["session_id", column], rows)
    return data, out


def write_dataset(folder, *, session=None, region="body", plan=PLAN, known=None):
    """A BIDS dataset and the participant level's output; the second group is thinner.

    ``known`` (subjects, x, y) tells which nodes have values.
    """
    data, out = begin_dataset(folder)
    cohorts = {hemi: simulate_cohort(plan, seed) for seed, hemi in enumerate("LR")}
    left = cohorts["L"]
    rows = []
    for i in range(len(left.age)):
        subject = f"{i + 1:02d}"
        for hemi, cohort in cohorts.items():
            place = place_of(out, subject, hemi, session=session, region=region)
            volume = 500 + 10 * np.sin(i) - 5 * left.group[i]
            maps = cohort.thickness[i], cohort.curvature[i]
            if known is not None:
                maps = [np.where(known[i], one, np.nan) for one in maps]
            write_hemisphere(place, *maps, volume=volume)
        sex = "F" if left.sex[i] else "M"
        rows.append([f"sub-{subject}", GROUPS[int(left.group[i])], f"{left.age[i]:.1f}", sex])
    write_participants(data, rows)
    return data, out


def write_participants(data, rows, columns=("participant_id", "group", "age", "sex")):
    files.write_tsv(data / "participants.tsv", columns, rows)


def read_participants(data):
    return [list(row.values()) for row in files.read_tsv(data / "participants.tsv")]


def run_named(dataset, *options):
    """Run the group level; the folder of results is named by the options."""
    data, out = dataset
    words = "".join(c if c.isalnum() else " " for c in " ".join(options[2:])).split()
    name = "-".join(words)
    assert main([str(data), str(out), "group", *options, "--name", name]) == 0
    return out / "group" / name


def table(path):
    """Read a table of results."""
    return pd.read_csv(path, sep="\t", na_values="n/a")


def methods_of(folder):
    """Read the methods text of results, whose works are numbered in its order and all cited."""
    text = (folder / "methods.md").read_text(encoding="utf-8")
    prose, _, works = text.partition("# References")
    cited = dict.fromkeys(re.findall(r"\[(\d+)\]", prose))
    assert list(cited) == re.findall(r"^(\d+)\. ", works, re.MULTILINE)
    return text
