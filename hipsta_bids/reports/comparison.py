"""The page of several analyses side by side, made from the files of their comparison."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from hipsta_bids.derivatives.names import COMPARISON
from hipsta_bids.io import files
from hipsta_bids.reports import cells
from hipsta_bids.reports.group import heading, methods, origin
from hipsta_bids.reports.group_maps import MOST_FIGURES, embedded
from hipsta_bids.reports.group_tables import GroupResults, records
from hipsta_bids.reports.maps import Picture
from hipsta_bids.reports.page import Section, build_sections, render

_TEMPLATE = "comparison/table.html"


def _analyses(results: GroupResults) -> Mapping[str, Any]:
    """List the analyses, with links to their pages."""
    pages = {name: f"{path}.html" for name, path in results.record["analyses"].items()}
    maps = results.record.get("maps") or {}
    rows = []
    for row in records(results.table("analyses")):
        name, page = row["analysis"], pages[row["analysis"]]
        linked = (name, page) if (results.folder.parent / page).exists() else name
        sides = f"{row['n_L']} left, {row['n_R']} right"
        texts = [_text(row[key]) for key in ("seg", "n", "groups")]
        failures = [_text(row[key]) for key in ("n_failed", "n_excluded", "correction")]
        rows.append([linked, *([maps[name]] if maps else []), *texts, sides, *failures])
    columns = ["Analysis", *(["Map"] if maps else []), "Protocol", "Participants", "Groups"]
    columns += ["Hemispheres", "Failed", "Excluded otherwise", "Correction"]
    text = (
        "Each analysis is corrected for multiple tests by itself. Error rates hold within an"
        " analysis, not over all analyses."
    )
    return _section("analyses", text, columns, rows)


def _maps(results: GroupResults) -> Mapping[str, Any] | None:
    """Show effect maps beside each other, and how far they agree."""
    table = results.table("agreement")
    if not len(table):
        return None
    pictures = [
        picture
        for measure in table["measure"].unique()
        for number in range(1, MOST_FIGURES)
        for name in [f"{measure}_maps" if number == 1 else f"{measure}_maps_{number}"]
        for picture in embedded(results, name, f"{cells.measure_title(measure)}: effect maps")
    ]
    rows = [
        [
            *(cells.measure_title(row["measure"]), cells.SIDES[row["hemi"]], row["contrast"]),
            f"{row['analysis']}, {row['other']}",
            *(cells.number_text(row["r"], 2), cells.number_text(row["dice"], 2)),
            *(_text(row[k]) for k in ("n_significant", "n_significant_other", "n_both")),
            *(_text(row[k]) for k in ("n_points", "n_shared")),
        ]
        for row in records(table)
    ]
    columns = ["Map", "Side", "Contrast", "Analyses", "r", "Dice", "Significant, first"]
    columns += ["second", "both", "Points", "Shared participants"]
    text = (
        "Effect sizes of one contrast have one color scale. Bold lines enclose significant points."
        " Thin lines are the borders of subfields in each analysis. r is Pearson's correlation of"
        " two effect maps over points. Neighboring points are not independent, so no p-value is"
        " given. Dice is the overlap of significant points with effects in one direction."
    )
    return _section("agreement", text, columns, rows) | {"pictures": pictures}


def _effects(results: GroupResults) -> Mapping[str, Any] | None:
    """List effects on the summary measures that two analyses or more have."""
    table = results.table("effects")
    rows = [
        [
            *(cells.measures_text(row["measure"], row["unit"]), row["contrast"]),
            *(cells.summary_side(row["hemi"], row["measure"]), row["analysis"], _text(row["n"])),
            *(cells.limits_text(row, "estimate"), cells.effect_text(row)),
            *(cells.p_text(row["p"]), cells.p_text(row["p_fdr"]), row["model"]),
        ]
        for row in _in_several(table, ["contrast", "measure", "hemi", "model"])
    ]
    columns = ["Measure", "Contrast", "Side", "Analysis", "n", "Estimate (limits)"]
    columns += ["Effect size (limits)", "p", "p, FDR", "Model"]
    text = (
        "The false discovery rate (FDR) holds within each analysis. The file also has measures that"
        " only one analysis has."
    )
    return _section("effects", text, columns, rows) if rows else None


def _classification(results: GroupResults) -> Mapping[str, Any] | None:
    """List areas under the curve of the analyses."""
    rows = [
        [
            f"{row['control']} against {row['case']}",
            *(cells.measures_text(row["added"]), cells.summary_side(row["hemi"], row["added"])),
            *(row["analysis"], _text(row["n"])),
            *(cells.limits_text(row, f"auc_{model}", 2) for model in ("base", "full")),
            *(cells.number_text(row[f"auc_{model}_cv"], 2) for model in ("base", "full")),
            cells.p_text(row["p"]),
        ]
        for row in _in_several(
            results.table("classification"), ["control", "case", "hemi", "added"]
        )
    ]
    columns = ["Groups", "Added", "Side", "Analysis", "n", "Area, base (limits)", "with it"]
    columns += ["Cross-validated, base", "with it", "p"]
    text = "Areas under the curve of logistic models, as on the page of each analysis."
    return _section("classification", text, columns, rows) if rows else None


def _in_several(table: pd.DataFrame, keys: list[str]) -> Iterator[dict[str, Any]]:
    """Return the rows whose keys two analyses or more have."""
    if len(table):
        yield from records(table[table.duplicated(keys, keep=False)])


def _section(
    file: str, text: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]
) -> dict[str, Any]:
    title, pictures = file.capitalize(), list[Picture]()
    about = {"title": title, "file": f"{file}.tsv", "text": text, "pictures": pictures}
    return {**about, "columns": columns, "rows": rows}


def _text(value: Any) -> str:  # noqa: ANN401  (a cell)
    """Write a count or a text."""
    return value if isinstance(value, str) else cells.number_text(float(value), 0)


#: Sections of the page, from top to bottom.
SECTIONS: tuple[Section[GroupResults], ...] = (
    Section("analyses", "Analyses", _TEMPLATE, _analyses),
    Section("maps", "Effect maps", _TEMPLATE, _maps),
    Section("effects", "Summary measures", _TEMPLATE, _effects),
    Section("classification", "Classification", _TEMPLATE, _classification),
    Section("methods", "Methods paragraph", "group/methods.html", methods),
    Section("origin", "Origin", "group/origin.html", origin),
)


def write_comparison_report(folder: Path) -> None:
    """Write the page of a comparison, beside its folder."""
    results = GroupResults(folder=folder, record=files.read_json(folder / COMPARISON))
    page = render(
        "group.html",
        title=f"Comparison of {len(results.record['analyses'])} analyses",
        folder=folder.name,
        **heading(results.record),
        cohort=False,
        sections=build_sections(SECTIONS, results, "comparison"),
    )
    files.write_text(folder.with_name(f"{folder.name}.html"), page)
