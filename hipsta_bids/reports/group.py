"""The page about one analysis: results, places, participants and methods."""

import base64
import contextlib
import io
import logging
import re
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.analyses import GroupResults, read_group, records
from hipsta_bids.derivatives.names import DATASET_FILES, group_report
from hipsta_bids.errors import HipstaError
from hipsta_bids.io import files
from hipsta_bids.io.files import hide_home
from hipsta_bids.protocols import EXPERIMENTAL
from hipsta_bids.reports import cells, group_tables
from hipsta_bids.reports.display import DESIGN_COLORS, colors_of
from hipsta_bids.reports.group_maps import embedded, map_scenes
from hipsta_bids.reports.page import Section, build_sections, render
from hipsta_bids.types import JOINT

_LOGGER = logging.getLogger(__name__)
_PREFIX = "group"
_ROW_HEIGHT, _LOWEST, _TALLEST = 6, 60, 360  # of the picture of a design matrix, CSS pixels
_SHADES = 64
_CHANCE = 0.5  # area under the curve of guesses


def design(results: GroupResults) -> Mapping[str, Any] | None:
    """Describe the model in words, by its contrasts, and as a picture of its design matrix."""
    record = results.record
    if "contrasts" not in record:
        return None
    table = results.table("design")
    columns = [str(name) for name in record.get("columns") or ()]
    measures = results.table("maps")
    sided = record.get("one_sided") or {}
    return {
        "formula": record.get("formula"),
        "measures": [m for m in measures["measure"].unique() if m != JOINT]
        if len(measures)
        else [],
        "what": group_tables.describe_rows(results)[0],
        "references": record.get("references") or {},
        "columns": columns,
        "contrasts": [
            (f"{name} ({sided[name]})" if name in sided else name, np.atleast_2d(weights).tolist())
            for name, weights in (record.get("contrasts") or {}).items()
        ],
        "picture": _matrix_picture(table, columns) if len(table) else None,
    }


def _matrix_picture(table: pd.DataFrame, columns: list[str]) -> dict[str, Any]:
    """Draw the design matrix, each column from its smallest to its largest value."""
    from PIL import Image  # noqa: PLC0415  (slow to load)

    matrix = table[columns].to_numpy(dtype=np.float64)
    low, high = matrix.min(axis=0), matrix.max(axis=0)
    share = np.where(high > low, (matrix - low) / np.where(high > low, high - low, 1.0), 1.0)
    shades = (share * (_SHADES - 1)).round().astype(np.uint8)
    image = Image.fromarray(shades, mode="P")
    colors = colors_of(DESIGN_COLORS, _SHADES)
    image.putpalette([int(color[i : i + 2], 16) for color in colors.tolist() for i in (1, 3, 5)])
    buffer = io.BytesIO()
    image.save(buffer, format="png", optimize=True)
    ends = [
        cells.number_text(a) if a == b else f"{cells.number_text(a)} to {cells.number_text(b)}"
        for a, b in zip(low, high, strict=True)
    ]
    return {
        "address": "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode(),
        "height": min(_TALLEST, max(_LOWEST, _ROW_HEIGHT * len(matrix))),
        "columns": list(zip(columns, ends, strict=True)),
        "rows": len(matrix),
        "colors": colors[::9].tolist(),
    }


def origin(results: GroupResults) -> Mapping[str, Any]:
    """List the facts needed to repeat the analysis."""
    record = results.record
    inputs = record.get("inputs") or {}
    settings = record.get("settings") or {}
    return {
        "command": hide_home(shlex.join(str(part) for part in record.get("command") or ())),
        "version": record.get("version"),
        "inputs": inputs,
        "datasets": [hide_home(str(path)) for path in inputs.get("datasets") or ()],
        "settings": [
            (f"{stage}.{name}", value)
            for stage, part in settings.items()
            for name, value in (part.items() if isinstance(part, Mapping) else [("", part)])
        ],
        "notes": record.get("notes") or [],
    }


def heading(record: Mapping[str, Any]) -> dict[str, Any]:
    """List the facts in the head of the page, of an analysis or of several together."""
    region = (record.get("inputs") or {}).get("region")
    return {
        "formula": record.get("formula"),
        "n": record.get("participants"),
        "made_by": record.get("version"),
        "region": region,
        "experimental": region in EXPERIMENTAL,
        "mixes": record.get("mixes") or (),
    }


def group_page(folder: Path) -> str:
    """Make the page about one analysis from its files."""
    results = read_group(folder)
    record = results.record
    return render(
        "group.html",
        title=results.name,
        folder=folder.name,
        **heading(record),
        cohort=(folder.parent.parent / DATASET_FILES["report"]).exists(),
        sections=build_sections(SECTIONS, results, _PREFIX, kind="sections"),
    )


def _classification(results: GroupResults) -> Mapping[str, Any] | None:
    """List how well groups are discriminated, with the curves of the first added measures."""
    rows = records(results.table("classification"))
    if not rows:
        return None
    first: dict[tuple[str, str], str] = {}
    for row in rows:
        pair = f"{row['control']} against {row['case']}"
        base, full = (cells.limits_text(row, f"auc_{model}", 2) for model in ("base", "full"))
        first.setdefault(
            (pair, cells.summary_side(row["hemi"], row["added"])),
            f"{cells.measures_text(row['base'])} {base},"
            f" with {cells.measures_text(row['added'])} {full}",
        )
    areas = "; ".join(f"{', '.join(key)}: {text}" for key, text in first.items())
    roc, calibration = "Receiver operating characteristics", "Calibration"
    alt = f"{roc}; areas under the curve: {areas}"
    pictures = embedded(results, "roc", roc, alt)
    pictures += embedded(
        results, "calibration", calibration, "Share of cases against cross-validated chance"
    )
    settings = (results.record.get("settings") or {}).get("classification") or {}
    return {
        "rows": rows,
        "pictures": pictures,
        "bases": list(dict.fromkeys(row["base"] for row in rows)),
        "least": settings.get("least_calibrated"),
        "judged": any(np.isfinite(row["calibration_slope"]) for row in rows),
        "chance": any(min(row["auc_base_cv"], row["auc_full_cv"]) < _CHANCE for row in rows),
    }


def _registration(results: GroupResults) -> Mapping[str, Any] | None:
    """Describe what registration explains, with its figure, and sheets with extreme warps."""
    table = results.table("registration")
    if not len(table):
        return None
    warps = results.table("warps")
    extreme = warps[warps["extreme"] == True] if len(warps) else warps  # noqa: E712  (may be text)
    if len(extreme):
        extreme = extreme.sort_values("displacement", ascending=False)
    settings = (results.record.get("settings") or {}).get("registration") or {}
    alignment = records(results.table("alignment"))
    names = {"registration": "Curvature before and after, warps, and positions"}
    for measure in dict.fromkeys(row["measure"] for row in alignment):
        title = f"Statistics with and without registration, {cells.display_name(measure)}"
        names |= {f"{measure}_alignment{end}": title for end in ("", "_2", "_3")}
    least = settings.get("min_subjects", 0)
    fewest = min((row["n"] for row in records(table)), default=least)
    return {
        "align": settings.get("align"),
        "least": least if fewest < least else None,
        "rows": records(table),
        "alignment": alignment,
        "extreme": records(extreme),
        "pictures": [
            picture for name, title in names.items() for picture in embedded(results, name, title)
        ],
    }


def _sections_of_groups(results: GroupResults) -> Mapping[str, Any] | None:
    """Show the average cross-sections of the groups."""
    alt = "Average cross-sections of the groups, from posterior to anterior"
    pictures = embedded(results, "sections", "Average cross-sections", alt)
    return {"picture": pictures[0]} if pictures else None


def methods(results: GroupResults) -> Mapping[str, Any] | None:
    """Take the methods paragraph apart for the page."""
    path = results.folder / "methods.md"
    if not path.exists():
        return None
    title, *blocks = _blocks(path.read_text(encoding="utf-8"))
    return {"blocks": blocks if title["kind"] == "heading" else [title, *blocks]}


def _blocks(text: str) -> list[dict[str, Any]]:
    """Split the markdown of ``methods.md`` into headings, lists and paragraphs."""
    blocks = []
    for part in re.split(r"\n\s*\n", text.strip()):
        lines = part.splitlines()
        items = [re.match(r"(-|\d+\.)\s+(.*)", line) for line in lines]
        if part.startswith("#"):
            blocks.append({"kind": "heading", "texts": [part.lstrip("# ")]})
        elif all(items):
            kind = "points" if part.startswith("-") else "numbers"
            blocks.append({"kind": kind, "texts": [item[2] for item in items if item]})
        else:
            blocks.append({"kind": "paragraph", "texts": [" ".join(lines)]})
    return blocks


#: Sections of the page, from top to bottom.
SECTIONS: tuple[Section[GroupResults], ...] = (
    Section("found", "What was found", "group/found.html", group_tables.findings),
    Section("people", "Participants", "group/people.html", group_tables.participants),
    Section("maps", "Maps", "group/maps.html", map_scenes),
    Section("peaks", "Clusters and peaks", "group/peaks.html", group_tables.peaks),
    Section("summaries", "Summary measures", "group/summaries.html", group_tables.summaries),
    Section("classification", "Classification", "group/classification.html", _classification),
    Section("model", "Model", "group/model.html", design),
    Section("registration", "Registration", "group/registration.html", _registration),
    Section("sections", "Average cross-sections", "group/sections.html", _sections_of_groups),
    Section("methods", "Methods paragraph", "group/methods.html", methods),
    Section("origin", "Origin", "group/origin.html", origin),
)


def write_group_report(
    root: Path, model: str, make: Callable[[Path], str] = group_page
) -> str | None:
    """Make the page about one analysis of the group level; a failure leaves no page."""
    path = root / group_report(model)
    try:
        files.write_text(path, make(root / DATASET_FILES["group"] / model))
    except Exception as error:  # results are worth more than pages
        if not isinstance(error, HipstaError):  # a bug shows its traceback
            _LOGGER.exception("report: %s", path.name)
        # That of an earlier analysis would be taken for this one's.
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
        cause = str(error) if isinstance(error, HipstaError) else f"{type(error).__name__}: {error}"
        return f"{path.name}: not made ({cause})"
    return None


def group_models(root: Path, record: str = "analysis.json") -> list[str]:
    """List the analyses of the group level that an output dataset holds, by their record."""
    records = (root / DATASET_FILES["group"]).glob(f"*/{record}")
    return sorted(path.parent.name for path in records if not path.parent.name.startswith("."))
