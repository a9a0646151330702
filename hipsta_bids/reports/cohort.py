"""Hemispheres of an output dataset: the range of their numbers, outliers, and what to do."""

import os
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids.derivatives.copies import describe_copies, same_labels
from hipsta_bids.derivatives.dataset import container_of_process
from hipsta_bids.derivatives.measures import read_compared
from hipsta_bids.derivatives.names import (
    DATASET_FILES,
    HemisphereName,
    output_name,
    participant_report,
)
from hipsta_bids.derivatives.outliers import FEWEST, SIZE, TEXT
from hipsta_bids.errors import InputError
from hipsta_bids.geometry.catalog import SUMMARY
from hipsta_bids.io import files
from hipsta_bids.joints import find_groupings
from hipsta_bids.protocols.toml import flatten, resolve
from hipsta_bids.reports.maps import make_sprites, read_maps
from hipsta_bids.reports.page import number, render
from hipsta_bids.reports.results import SURFACES, Hemisphere, Views, find_results, input_path
from hipsta_bids.reports.verdict import Verdict, verdict_of
from hipsta_bids.settings import PUBLISHED, Settings
from hipsta_bids.types import RATINGS, Decision, Float

#: Least number of hemispheres whose range is shown.
SMALLEST_COHORT = 5

#: Columns of the table, with shorter titles than those of the measures.
_SUMMARY = {
    "thickness_mean": "Thickness",
    "curvature_mean": "Curvature",
    "volume": "Volume",
    "area_mid": "Area",
    "extent_y": "Sheet length",
}
_QUALITY = {
    "voxels_across": "Voxels across",
    "repaired_fraction": "Repaired",
    "filled_fraction": "Filled",
}


#: Numbers of the summary that pages show, in their order: titles and decimals.
_TITLES = {
    "thickness_mean": ("Mean thickness", 2),
    "curvature_mean": ("Mean curvature", 3),
    "volume": ("Volume", 0),
    "area_mid": ("Area of the mid-surface", 0),
    "extent_x": ("Width of the sheet, medial to lateral", 1),
    "extent_y": ("Length of the sheet, posterior to anterior", 1),
    "interior_exterior_ratio_mean": ("Interior to exterior length", 2),
    "shape_index_mean": ("Shape index", 2),
}
_UNITS = {row.name: row.unit for row in SUMMARY}

#: Title, unit and decimals of these, by name.
MEASURES: dict[str, dict[str, Any]] = {
    name: {"title": title, "unit": _UNITS[name].removesuffix("1"), "digits": digits}
    for name, (title, digits) in _TITLES.items()
}

_RUN = re.compile(r"^(?P<time>\d{4}-\d\d-\d\d \d\d:\d\d):\d\d,\d+ INFO (?P<text>.*)$")
_COMMAND = "command: "
_OUTCOME = re.compile(r"(?P<title>sub-\S+_hemi-\S+): (?:use|look|failed)\b")


@dataclass(frozen=True, eq=False, kw_only=True)
class Cohort:
    """Hemispheres of one output dataset."""

    hemispheres: tuple[Hemisphere, ...]
    settings: Mapping[str, Any]
    """Resolved, by stage."""
    compared: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """Cells of ``measures.tsv`` of hemispheres that were compared with others, by title."""
    origins: Mapping[str, tuple[str | None, str]] = field(default_factory=dict)
    """Command and time of the run that measured a hemisphere, by its title; from the logs."""

    def like(self, name: HemisphereName) -> list[Hemisphere]:
        """Measured hemispheres of the same side, protocol and region."""
        kind = _kind(name)
        return [h for h in self.hemispheres if h.measured and _kind(h.result.name) == kind]

    @cached_property
    def verdicts(self) -> Mapping[str, Verdict]:
        """Verdicts of the hemispheres' pages, by title of the hemisphere."""
        return {h.result.name.title: verdict_of(h) for h in self.hemispheres}

    @cached_property
    def ranking(self) -> list[Hemisphere]:
        """All hemispheres: failed ones, then ones to look at, the largest consequence first."""
        return sorted(self.hemispheres, key=lambda h: self.verdicts[h.result.name.title].rank)

    def profiles(self, name: HemisphereName, column: str) -> Float:
        """(N, Nx) means over y of a map, of all hemispheres of the same kind."""
        rows = [h.profile[column] for h in self.like(name) if column in h.profile]
        profiles = [row for row in rows if len(row) == len(rows[0])]
        return np.array(profiles, dtype=np.float64)

    def values(self, name: HemisphereName, measure: str) -> Float:
        """Collect a number of all hemispheres of the same kind, without NaN."""
        values = [hemisphere.summary.get(measure, np.nan) for hemisphere in self.like(name)]
        array = np.array(values, dtype=np.float64)
        return array[np.isfinite(array)]


def _kind(name: HemisphereName) -> tuple[str, str, str]:
    return name.hemi, name.seg, name.region


def read_cohort(root: Path) -> Cohort:
    """Read the numbers of all hemispheres."""
    try:
        settings = files.read_json(root / DATASET_FILES["settings"]).get("settings") or {}
    except InputError:
        settings = {}
    hemispheres = tuple(hemisphere for hemisphere in find_results(root) if _is_readable(hemisphere))
    return Cohort(
        hemispheres=hemispheres,
        settings=settings,
        compared=read_compared(root),
        origins=_read_origins(root),
    )


def _is_readable(hemisphere: Hemisphere) -> bool:
    try:
        return bool(hemisphere.summary) or not hemisphere.measured
    except InputError:
        return False


def _read_origins(root: Path) -> dict[str, tuple[str | None, str]]:
    """Read from the logs which command measured each hemisphere last."""
    origins = {}
    for path in sorted((root / DATASET_FILES["logs"]).glob("run-*.log")):
        command = None
        try:
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError:
            continue
        for line in text.splitlines():
            entry = _RUN.match(line)
            if entry is None:
                continue
            if entry["text"].startswith(_COMMAND):
                command = entry["text"].removeprefix(_COMMAND)
            elif (outcome := _OUTCOME.match(entry["text"])) is not None:
                origins[outcome["title"]] = command, entry["time"]
    return origins


def cohort_page(cohort: Cohort) -> str | None:
    """Make the page about all hemispheres of an output dataset."""
    hemispheres = cohort.ranking
    if not hemispheres:
        return None
    maps = [read_maps(h) if h.measured else {} for h in hemispheres]
    sprites, columns, tiles = make_sprites(maps)
    counts = Counter(h.decision for h in hemispheres)
    rows = [_row(h, cohort, tiles.get(n)) for n, h in enumerate(hemispheres)]
    return render(
        "cohort.html",
        title="All hemispheres",
        n=len(hemispheres),
        n_participants=len({h.result.name.subject for h in hemispheres}),
        counts=[(str(word), counts[word]) for word in Decision if counts[word]],
        copies=[
            describe_copies(names)
            for names in same_labels((h.result.name, h.record) for h in hemispheres)
        ],
        n_apart=sum(bool(row["farthest"]) for row in rows),
        smallest=FEWEST,
        compared=bool(cohort.compared),
        sprites=sprites,
        ratings=RATINGS,
        data={
            "columns": _columns(hemispheres, compared=bool(cohort.compared)),
            "rows": rows,
            "ratings": RATINGS,
            "grid": {
                "columns": columns,
                "rows": max(1, -(-len(tiles) // columns)),
                "aspect": _aspect(hemispheres),
            },
        },
    )


def _columns(hemispheres: Sequence[Hemisphere], *, compared: bool) -> list[Mapping[str, Any]]:
    """Columns of the table; those of one protocol, or of bodies alone, are left out."""
    names = [h.result.name for h in hemispheres]
    columns: list[Mapping[str, Any]] = [
        {"key": "participant", "title": "Participant"},
        {"key": "decision", "title": "Decision"},
    ]
    if any(name.session for name in names):
        columns.append({"key": "session", "title": "Session"})
    columns.append({"key": "hemi", "title": "Side"})
    if len({name.seg for name in names}) > 1:
        columns.append({"key": "seg", "title": "Protocol"})
    if any(name.region != "body" for name in names):
        columns.append({"key": "region", "title": "Region"})
    columns += [
        {"key": "rating", "title": "Rating"},
        {"key": "reason", "title": "Reason"},
        {
            "key": "change",
            "title": "Mean off by",
            "unit": "mm",
            "digits": 2,
            "help": "what the mean thickness could be off by, for the reason",
        },
        {
            "key": "share",
            "title": "Of the map",
            "digits": 0,
            "percent": True,
            "help": "share of the map that could be wrong, for the reason",
        },
    ]
    if compared:
        about = "step of thickness at the patch that differs most from the other hemispheres"
        patch = {"title": "Largest step", "unit": "mm", "digits": 2, "help": about}
        columns += [{"key": "distance", **patch}, {"key": "farthest", "title": "Outlier"}]
    for key, title in _SUMMARY.items():
        columns.append({"key": key, **MEASURES[key], "title": title})
    for key, title in _QUALITY.items():
        percent = {"percent": True} if key.endswith("fraction") else {}
        columns.append({"key": key, "title": title, "digits": 1, **percent})
    return columns


def _row(hemisphere: Hemisphere, cohort: Cohort, tile: int | None) -> dict[str, Any]:
    name, record = hemisphere.result.name, hemisphere.record
    verdict, compared = cohort.verdicts[name.title], cohort.compared.get(name.title, {})
    numbers = {key: hemisphere.summary.get(key, np.nan) for key in _SUMMARY}
    numbers |= {key: number(hemisphere.metrics, key) for key in _QUALITY}
    numbers |= {"change": abs(verdict.change), "share": verdict.share}
    return {
        "key": name.title,
        "page": participant_report(name.subject, name.session),
        "hash": record.get("input_hash") or "",
        "participant": f"sub-{name.subject}",
        "session": f"ses-{name.session}" if name.session else None,
        "hemi": name.hemi,
        "seg": name.seg,
        "region": name.region,
        "decision": str(verdict.decision),
        "verdict": verdict.title,
        "because": f"{verdict.reason} {verdict.consequence}",
        "reason": record.get("reason") or "",
        "message": hemisphere.message,
        "distance": float(compared[SIZE]) if compared else None,
        "farthest": compared.get(TEXT, "").replace(files.MISSING, ""),
        "tile": tile,
        **{key: float(f"{v:.6g}") if np.isfinite(v) else None for key, v in numbers.items()},
    }


def _aspect(hemispheres: Sequence[Hemisphere]) -> float:
    """Median length over width of the sheets."""
    ratios = [
        h.summary["extent_y"] / h.summary["extent_x"]
        for h in hemispheres
        if np.isfinite(h.summary.get("extent_x", np.nan)) and h.summary["extent_x"] > 0
    ]
    return round(float(np.median(ratios)), 3) if ratios else 1.0


#: Colors of the edges of surfaces where FreeView cuts them, as in the slices of a page.
_EDGES = dict(zip(SURFACES, ("green", "white", "magenta"), strict=True))


#: What ITK-SNAP reads.
_NIFTI = (".nii", ".nii.gz")


def card_of(hemisphere: Hemisphere, cohort: Cohort, views: Views | None) -> Mapping[str, Any]:
    """Collect the head of a hemisphere's page, and its links."""
    key, record = hemisphere.result.name.title, hemisphere.record
    order = [hemisphere.result.name.title for hemisphere in cohort.ranking]
    n = order.index(key) if key in order else None
    before = cohort.ranking[n - 1] if n else None
    after = cohort.ranking[n + 1] if n is not None and n + 1 < len(order) else None
    return {
        "key": key,
        "hash": record.get("input_hash") or "",
        "side": hemisphere.side,
        "verdict": cohort.verdicts.get(key) or verdict_of(hemisphere),
        "findings": hemisphere.findings,
        "notes": record.get("notes") or [],
        "edited": [str(e.get("what")) for e in record.get("edited") or []],
        "neighbors": [("previous", _link(before, cohort)), ("next", _link(after, cohort))],
        "commands": open_commands(
            hemisphere, views.anatomy.path if views and views.anatomy else None
        ),
    }


def _link(hemisphere: Hemisphere | None, cohort: Cohort) -> tuple[str, str] | None:
    """Address and words of a link to a hemisphere's part of its page."""
    if hemisphere is None:
        return None
    name = hemisphere.result.name
    title = name.title
    verdict = cohort.verdicts[title].title.lower()
    words = f"sub-{name.subject}{f' ses-{name.session}' if name.session else ''} {hemisphere.side}"
    if len({hemisphere.result.name.protocol for hemisphere in cohort.hemispheres}) > 1:
        words += " " + " ".join(filter(None, (name.seg, name.region_title)))
    return f"{participant_report(name.subject, name.session)}#{title}", f"{words}: {verdict}"


def open_commands(hemisphere: Hemisphere, anatomy: Path | None = None) -> list[tuple[str, str]]:
    """Write commands, by program, that open the files of a hemisphere from the output folder.

    In a container the folder with the labels is ``LABELS_DIR``, to be replaced.
    """
    result = hemisphere.result
    labels, mask = input_path(hemisphere), result.path("body_mask")
    volumes, behind = [], []
    if labels is not None and labels.exists():
        # Docker's paths mean nothing outside; Apptainer's are those of the machine.
        hidden = container_of_process().get("Type") == "docker"
        address = f"LABELS_DIR/{labels.name}" if hidden else _from(result.root, labels)
        volumes.append((address, ":colormap=lut:opacity=0.5"))
        if anatomy is not None and not hidden:
            behind = [_from(result.root, anatomy)]
    if mask.exists():
        volumes.append((_from(result.root, mask), ":colormap=heat:opacity=0.3"))
    if not volumes:
        return []
    return [
        ("FreeView", _freeview_command(hemisphere, volumes, behind)),
        ("ITK-SNAP", _itksnap_command([path for path, _ in volumes], behind)),
    ]


def _freeview_command(
    hemisphere: Hemisphere, volumes: Iterable[tuple[str, str]], behind: Iterable[str]
) -> str:
    result = hemisphere.result
    freeview = ["freeview", "-v", *behind, *(path + look for path, look in volumes)]
    surfaces = {name: result.path(f"{name}_surface") for name in SURFACES}
    if all(path.exists() for path in surfaces.values()):
        freeview.append("-f")
        freeview += [
            f"{_from(result.root, path)}:edgecolor={_EDGES[name]}"
            for name, path in surfaces.items()
        ]
    point = next((f.point for f in hemisphere.findings if f.point is not None), None)
    if point is not None:
        freeview += ["-ras", *(f"{value:g}" for value in point)]
    return shlex.join(freeview)


def _itksnap_command(volumes: Sequence[str], behind: Iterable[str]) -> str:
    first, before = volumes[0], ""
    if not first.endswith(_NIFTI):
        before, first = f"mri_convert {shlex.quote(first)} labels.nii.gz && ", "labels.nii.gz"
    snap = ["itksnap", "-g", first]
    if len(volumes) > 1:
        snap += ["-s", volumes[1]]
    snap += [word for path in behind if path.endswith(_NIFTI) for word in ("-o", path)]
    return before + shlex.join(snap)


def _from(root: Path, path: Path) -> str:
    return Path(os.path.relpath(path, root)).as_posix()


def settings_options(settings: Mapping[str, Any]) -> list[str]:
    """Return the options that a later run in a folder with these resolved settings needs."""
    recorded = flatten(settings)
    options = _grouping_words(recorded)
    recorded.pop("body.region", None)  # one folder may hold several
    default = flatten(resolve(Settings()))
    changed = {
        key: value for key, value in recorded.items() if key in default and value != default[key]
    }
    if changed == flatten(PUBLISHED):
        return [*options, "--method", "published"]
    return [*options, "--settings", "FILE"] if changed else options


def _grouping_words(recorded: dict[str, Any]) -> list[str]:
    """Return the options that measure hemispheres together; take their settings out."""
    pairs = [(g.commands, recorded.pop(g.setting, None)) for g in find_groupings()]
    return list(chain.from_iterable(commands.get(str(value), ()) for commands, value in pairs))


def correction_of(
    hemispheres: Sequence[Hemisphere], settings: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Name the files to correct, their folder, and the command that measures them again."""
    first = hemispheres[0].result.name
    choices = []
    for hemisphere in hemispheres:
        name = hemisphere.result.name
        mask = hemisphere.result.path("body_mask")
        by_mask = mask.exists() and name.region == "body"  # of other regions labels are corrected
        path = input_path(hemisphere)
        suffix = f"{name.title}_desc-edited"
        choices.append(
            {
                "side": hemisphere.side,
                "labels": path.name if path else None,
                "edited_labels": f"{suffix}_dseg.nii.gz",
                "mask": output_name(name, "body_mask") if by_mask else None,
                "edited_mask": f"{suffix}_mask.nii.gz",
            }
        )
    command = ["hipsta-bids", "BIDS_DIR", "OUT_DIR", "participant", "--edited-dir", "EDITS"]
    command += ["--participant-label", first.subject]
    command += ["--region", first.region] if first.region != "body" else []
    command += settings_options(settings)
    return {
        "choices": choices,
        "folder": f"EDITS/{first.folder}",
        "command": shlex.join(command),
        "has_file": "FILE" in command,
        "is_grouped": bool(_grouping_words(flatten(settings))),
    }
