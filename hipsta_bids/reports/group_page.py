"""The page about one analysis: what it found and where, in whom, and how."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hipsta_bids.bids.names import DATASET_FILES
from hipsta_bids.reports.figures import picture_of_file
from hipsta_bids.reports.group_curves import classifiers, registration
from hipsta_bids.reports.group_design import design, origin
from hipsta_bids.reports.group_findings import findings
from hipsta_bids.reports.group_maps import map_scenes
from hipsta_bids.reports.group_results import GroupResults, read_group
from hipsta_bids.reports.group_tables import participants, peaks, scores, summaries
from hipsta_bids.reports.page import Section, build_sections, render

_PREFIX = "group"


def group_page(folder: Path) -> str:
    """Make the page about one analysis from its files.

    Parameters
    ----------
    folder : Path
        Of the model, ``OUT_DIR/group/<model>``.

    Returns
    -------
    str
        The page.

    Raises
    ------
    InputError
        If ``analysis.json`` cannot be read.
    """
    results = read_group(folder)
    record = results.record
    return render(
        "group.html",
        title=results.name,
        folder=folder.name,
        formula=record.get("formula"),
        n=record.get("participants"),
        made_by=record.get("version"),
        cohort=(folder.parent.parent / DATASET_FILES["report"]).exists(),
        sections=build_sections(SECTIONS, results, _PREFIX),
    )


def _sections_of_groups(results: GroupResults) -> Mapping[str, Any] | None:
    """Show the average cross-sections, and maps on other surfaces, as the figures have them."""
    path = results.folder / "figures" / "sections.svg"
    if not path.exists():
        return None
    alt = "Average cross-sections of the groups, from posterior to anterior"
    return {"picture": picture_of_file(path, alt=alt, caption="Average cross-sections")}


def _maps(results: GroupResults) -> Mapping[str, Any] | None:
    values = map_scenes(results)
    if values is None:
        return None
    figures = results.folder / "figures"
    pictures = [
        picture_of_file(figures / f"{one['name']}.svg", alt=one["title"], caption=one["title"])
        for one in values["pictures"]
    ]
    return {**values, "pictures": pictures}


def _methods(results: GroupResults) -> Mapping[str, Any] | None:
    path = results.folder / "methods.md"
    if not path.exists():
        return None
    title, *blocks = _blocks(path.read_text(encoding="utf-8"))
    return {"blocks": blocks if title["kind"] == "heading" else [title, *blocks]}


def _blocks(text: str) -> list[dict[str, Any]]:
    """Part the markdown of ``methods.md``: headings, lists and paragraphs; code is marked."""
    blocks = []
    for part in re.split(r"\n\s*\n", text.strip()):
        lines = part.splitlines()
        items = [re.match(r"(-|\d+\.)\s+(.*)", line) for line in lines]
        if part.startswith("#"):
            blocks.append({"kind": "heading", "runs": [_runs(part.lstrip("# "))]})
        elif all(items):
            kind = "points" if part.startswith("-") else "numbers"
            blocks.append({"kind": kind, "runs": [_runs(item[2]) for item in items if item]})
        else:
            blocks.append({"kind": "paragraph", "runs": [_runs(" ".join(lines))]})
    return blocks


def _runs(text: str) -> list[tuple[bool, str]]:
    """Part a text into runs, and tell which are code."""
    return [(i % 2 == 1, run) for i, run in enumerate(text.split("`")) if run]


#: From top to bottom.
SECTIONS: tuple[Section[GroupResults], ...] = (
    Section(key="found", title="What was found", template="group/found.html", build=findings),
    Section(key="maps", title="Maps", template="group/maps.html", build=_maps),
    Section(key="peaks", title="Clusters and peaks", template="group/peaks.html", build=peaks),
    Section(
        key="summaries", title="Summary measures", template="group/summaries.html", build=summaries
    ),
    Section(
        key="classification",
        title="Classification",
        template="group/classification.html",
        build=classifiers,
    ),
    Section(key="scores", title="w-scores", template="group/scores.html", build=scores),
    Section(key="people", title="Participants", template="group/people.html", build=participants),
    Section(key="model", title="Model", template="group/model.html", build=design),
    Section(
        key="registration",
        title="Registration",
        template="group/registration.html",
        build=registration,
    ),
    Section(
        key="sections",
        title="Average cross-sections",
        template="group/sections.html",
        build=_sections_of_groups,
    ),
    Section(
        key="methods", title="Methods paragraph", template="group/methods.html", build=_methods
    ),
    Section(key="origin", title="Origin", template="group/origin.html", build=origin),
)
