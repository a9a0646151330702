"""Several protocols, datasets or programs: their analyses, and a comparison from their files."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pandas as pd

from hipsta_bids import __version__
from hipsta_bids.derivatives.analyses import GroupResults, read_group
from hipsta_bids.errors import MissingFileError, ModelError, OutputError, UsageError
from hipsta_bids.extensions.agreement import COMPARISON, tables
from hipsta_bids.extensions.agreement.columns import COMPARISON_COLUMNS
from hipsta_bids.extensions.agreement.page import write_comparison_page
from hipsta_bids.extensions.agreement.tables import Entry
from hipsta_bids.group.output import write
from hipsta_bids.group.output.citations import joined
from hipsta_bids.group.output.panels import draw_pages
from hipsta_bids.group.questions.compare import run_group
from hipsta_bids.group.questions.study import GroupOptions, GroupResult
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files

_PAIRS = ("control", "case", "hemi", "added")


def run_protocols(
    options: GroupOptions, settings: GroupSettings, protocols: Sequence[str]
) -> GroupResult:
    """Analyze the same participants once per protocol, and compare the results."""
    results = {
        seg: run_group(
            replace(options, sheets=replace(options.sheets, seg=seg), part=f"_seg-{seg}"), settings
        )
        for seg in protocols
    }
    first = results[protocols[0]].folder
    folder = first.with_name(first.name.removesuffix(f"_seg-{protocols[0]}"))
    entries = read_entries([(seg, result.folder) for seg, result in results.items()])
    notes = compare_analyses(
        entries,
        folder,
        options.command,
        figures=options.figures,
        reports=options.reports,
    )
    people = set[str]().union(*(entry.people for entry in entries))
    return GroupResult(
        folder=folder,
        n_participants=len(people),
        n_excluded=sum(result.n_excluded for result in results.values()),
        notes=(*_of_each(results, "notes"), *notes),
        warnings=_of_each(results, "warnings"),
        page=folder.with_name(f"{folder.name}.html") if options.reports else None,
        problem="; ".join(result.problem for result in results.values() if result.problem) or None,
    )


def _of_each(results: Mapping[str, GroupResult], kind: str) -> tuple[str, ...]:
    return tuple(f"{seg}: {line}" for seg, one in results.items() for line in getattr(one, kind))


def open_analysis(folder: Path) -> GroupResults:
    """Read the record of a finished analysis, or refuse a folder without one."""
    if not (folder / "analysis.json").is_file():
        raise MissingFileError(
            f"{folder}: no analysis of the group level; give a folder OUT_DIR/group/MODEL"
        )
    return read_group(folder)


def read_entries(analyses: Sequence[tuple[str | None, Path]]) -> list[Entry]:
    """Read finished analyses by name; ``FOLDER:MAP`` is one map of an analysis."""
    entries = list[Entry]()
    for name, path in analyses:
        text, colon, measure = str(path).rpartition(":")
        folder, choice = (path, None) if not colon or path.is_dir() else (Path(text), measure)
        results = open_analysis(folder)
        title = name or folder.resolve().name
        if title in [entry.name for entry in entries]:
            raise UsageError(f"compare: two analyses are called {title}; name them, a={path} b=...")
        maps = results.table("maps")
        names = sorted(maps["measure"].unique()) if len(maps) else []
        if choice and choice not in names:
            raise UsageError(f"{folder}: has no map {choice}; there is {joined(names)}")
        alias = entries[0].alias if entries else choice
        entries.append(Entry(name=title, results=results, measure=choice, alias=alias))
    if len(entries) < 2:  # noqa: PLR2004 -- to compare
        raise UsageError("compare: give two analyses or more")
    if len({entry.measure is None for entry in entries}) > 1:
        raise UsageError("compare: name a map (FOLDER:MAP) of each analysis, or of none")
    return entries


def compare_analyses(
    entries: Sequence[Entry],
    folder: Path,
    command: Sequence[str] = (),
    *,
    figures: bool = False,
    reports: bool = True,
) -> list[str]:
    """Compare finished analyses, write tables, a figure and a page, and return notes."""
    contents = _tables(entries)
    pairs = contents["agreement"]
    notes = list(tables.differences(entries))
    region = entries[0].inputs.get("region") or "body"
    record = _record(entries, folder, contents["analyses"], command, region)
    with write.whole_folder(folder) as scratch:
        for name, content in contents.items():
            if len(content):
                write.write_table(scratch, name, content, meaning=COMPARISON_COLUMNS)
        drawings = [
            (f"{measure}_maps", partial(draw_pages, *tables.effect_rows(entries, measure)))
            for measure in dict.fromkeys(pairs["measure"] if len(pairs) else ())
        ]
        notes += write.write_figures(scratch, drawings, prints=figures)
        methods = tables.agreement_methods(entries, pairs, notes, region)
        files.write_text(scratch / "methods.md", methods)
        files.write_json(scratch / COMPARISON, {**record, "notes": notes})
    write_comparison_page(folder, reports=reports)
    return notes


def _tables(entries: Sequence[Entry]) -> dict[str, pd.DataFrame]:
    """Make the tables of a comparison; refuse analyses without a contrast of one name."""
    contents = {
        "analyses": tables.analyses_table(entries),
        "effects": tables.effects_table(entries),
        "classification": tables.joined_tables(entries, "classification", _PAIRS),
        "agreement": tables.agreement_table(entries),
    }
    effects = contents["effects"]
    tests = effects.groupby(["contrast", "measure"])["analysis"].nunique() if len(effects) else [0]
    if not len(contents["agreement"]) and max(tests) < 2:  # noqa: PLR2004 -- analyses
        raise ModelError(
            "compare: two analyses have no contrast of one name; give both the same --contrast"
        )
    return contents


def _record(
    entries: Sequence[Entry],
    folder: Path,
    analyses: pd.DataFrame,
    command: Sequence[str],
    region: str,
) -> dict[str, object]:
    """Record what is compared; folders are relative to that of the comparison."""
    return {
        "command": list(command),
        "version": __version__,
        "analyses": {
            entry.name: os.path.relpath(entry.results.folder, folder.parent) for entry in entries
        },
        "maps": {entry.name: entry.measure for entry in entries if entry.measure},
        "formula": joined(list(dict.fromkeys(analyses["formula"].astype(str)))),
        "participants": joined(analyses["n"].astype(str).tolist()),
        "inputs": {
            "datasets": [str(entry.results.folder.resolve()) for entry in entries],
            "region": region,
            **dict.fromkeys(("versions", "seg", "settings_hash")),
        },
    }


def check_folder(folder: Path) -> None:
    """Refuse a folder that holds something else than an earlier comparison."""
    if folder.exists() and not (folder / COMPARISON).exists():
        raise OutputError(
            f"{folder}: is no earlier comparison; choose another output folder",
            reason="not-writable",
        )
