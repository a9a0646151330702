"""The page of several analyses side by side, made from the files of their comparison."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hipsta_bids.derivatives.analyses import GroupResults, records
from hipsta_bids.extensions.agreement import COMPARISON
from hipsta_bids.io import files
from hipsta_bids.reports import cells
from hipsta_bids.reports.group import heading, methods, origin
from hipsta_bids.reports.group_maps import MOST_FIGURES, embedded
from hipsta_bids.reports.page import Section, build_sections, render
from hipsta_bids.types import SIDES, p_text

_TEMPLATE = "group/table.html"
_MOST_LINES = 12  # of findings; all are in the table of effect maps
_HEADINGS = {
    "seg": "Protocol", "n_L": "Left", "n_R": "Right", "n_failed": "Failed", "hemi": "Side",
    "n_excluded": "Excluded otherwise", "n_shared": "Shared participants", "r": "r", "n": "n",
    "other": "Compared with", "n_points": "Points", "n_significant": "Significant", "p": "p",
    "n_significant_other": "in the other", "n_both": "in both", "p_fdr": "p, FDR",
    "auc_base": "Area, base", "auc_full": "Area, with added",
    "auc_base_cv": "Cross-validated, base", "auc_full_cv": "Cross-validated, with added",
}  # fmt: skip


def _table(
    results: GroupResults, name: str, text: str, columns: Sequence[str], keys: Sequence[str] = ()
) -> dict[str, Any] | None:
    """Show columns of a table; with ``keys`` the rows whose keys two analyses or more have."""
    table = results.table(name)
    if len(table) and keys:
        table = table[table.duplicated([*keys], keep=False)]
    if not len(table):
        return None
    return {
        "title": name.capitalize(),
        "file": f"{name}.tsv",
        "text": text,
        "pictures": [],
        "columns": [_HEADINGS.get(c, c.replace("_", " ").capitalize()) for c in columns],
        "rows": [[_cell(row, c) for c in columns] for row in records(table)],
    }


def _cell(row: Mapping[str, Any], name: str) -> str:
    """Write a cell, a number with its limits."""
    value, measure = row[name], row.get("added") or row.get("measure") or ""
    if name == "hemi":
        return SIDES[value] if "dice" in row else cells.summary_side(value, measure)
    if isinstance(value, str):
        is_measure = name in {"measure", "added"}
        return cells.measures_text(value, row.get("unit", "1")) if is_measure else value
    if f"{name}_low" in row:
        return cells.limits_text(row, name)
    if name == "effect_size":
        return cells.effect_text(row)
    return p_text(value) if name in {"p", "p_fdr"} else cells.number_text(value)


def _findings(results: GroupResults) -> Mapping[str, Any] | None:
    """Write how many points are significant in two analyses, and how far their effects agree."""
    lines = []
    for row in records(results.table("agreement")):
        title = f"{cells.measure_title(row['measure'])}, {row['contrast']}"
        total, first, second, shared = (
            cells.number_text(row[f"n_{name}"], 0)
            for name in ("points", "significant", "significant_other", "both")
        )
        text = (
            f"{first} of {total} points are significant in {row['analysis']}, {second} in"
            f" {row['other']}, {shared} in both; r {cells.number_text(row['r'], 2)}, Dice"
            f" {cells.number_text(row['dice'], 2)}"
        )
        lines.append((f"{title}, {SIDES[row['hemi']]}", text))
    return {"lines": lines[:_MOST_LINES], "more": len(lines[_MOST_LINES:])} if lines else None


def _analyses(results: GroupResults) -> Mapping[str, Any] | None:
    """List the analyses, with links to their pages."""
    columns = ["analysis", "seg", "n", "groups", "n_L", "n_R", "n_failed", "n_excluded"]
    text = (
        "Each analysis is corrected for multiple tests by itself. Error rates hold within an"
        " analysis, not over all analyses."
    )
    section = _table(results, "analyses", text, [*columns, "correction"])
    pages = {name: f"{path}.html" for name, path in results.record["analyses"].items()}
    maps = results.record.get("maps") or {}
    for row in section["rows"] if section else ():
        title = f"{row[0]}, map {maps[row[0]]}" if maps else row[0]
        exists = (results.folder.parent / pages[row[0]]).exists()
        row[0] = (title, pages[row[0]]) if exists else title
    return section


def _maps(results: GroupResults) -> Mapping[str, Any] | None:
    """Show effect maps side by side, and how far they agree."""
    table = results.table("agreement")
    columns = ["measure", "hemi", "contrast", "analysis", "other", "r", "dice", "n_significant"]
    text = (
        "Effect sizes of one contrast have one color scale. Bold lines enclose significant points."
        " Thin lines are the borders of subfields in each analysis. r is Pearson's correlation of"
        " two effect maps over points. Neighboring points are not independent, so no p-value is"
        " given. Dice is the overlap of significant points with effects in one direction."
    )
    columns += ["n_significant_other", "n_both", "n_points", "n_shared"]
    section = _table(results, "agreement", text, columns)
    pictures = [
        picture
        for measure in (table["measure"].unique() if section else ())
        for number in range(1, MOST_FIGURES)
        for name in [f"{measure}_maps" if number == 1 else f"{measure}_maps_{number}"]
        for picture in embedded(results, name, f"{cells.measure_title(measure)}: effect maps")
    ]
    return section and section | {"pictures": pictures}


def _effects(results: GroupResults) -> Mapping[str, Any] | None:
    """List effects on the summary measures that two analyses or more have."""
    columns = ["analysis", "n", "estimate", "effect_size", "p", "p_fdr", "model"]
    text = (
        "The false discovery rate (FDR) holds within each analysis. The file also has measures that"
        " only one analysis has."
    )
    keys = ["measure", "hemi", "contrast"]
    return _table(results, "effects", text, [*keys, *columns], [*keys, "model"])


def _classification(results: GroupResults) -> Mapping[str, Any] | None:
    """List areas under the curve of the analyses."""
    columns = ["analysis", "n", "auc_base", "auc_full", "auc_base_cv", "auc_full_cv", "p"]
    text = "Areas under the curve of logistic models, as on the page of each analysis."
    keys = ["control", "case", "added", "hemi"]
    return _table(results, "classification", text, [*keys, *columns], keys)


#: Sections of the page, from top to bottom.
SECTIONS: tuple[Section[GroupResults], ...] = (
    Section("found", "What was found", "comparison/found.html", _findings),
    Section("analyses", "Analyses", _TEMPLATE, _analyses),
    Section("maps", "Effect maps", _TEMPLATE, _maps),
    Section("effects", "Summary measures", _TEMPLATE, _effects),
    Section("classification", "Classification", _TEMPLATE, _classification),
    Section("methods", "Methods paragraph", "group/methods.html", methods),
    Section("origin", "Origin", "group/origin.html", origin),
)


def comparison_page(folder: Path) -> str:
    """Make the page of a comparison from the files of its folder."""
    results = GroupResults(folder=folder, record=files.read_json(folder / COMPARISON))
    return render(
        "group.html",
        title=f"Comparison of {len(results.record['analyses'])} analyses",
        folder=folder.name,
        **heading(results.record),
        cohort=False,
        sections=build_sections(SECTIONS, results, "comparison"),
    )


def write_comparison_page(folder: Path, *, reports: bool) -> None:
    """Write the page of a comparison beside its folder."""
    path = folder.with_name(f"{folder.name}.html")
    files.remove([path])  # it may be that of an earlier comparison
    if reports:
        files.write_text(path, comparison_page(folder))
