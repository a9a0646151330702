"""Section of the page of an analysis: thickness in single slices by group."""

from collections.abc import Mapping
from typing import Any

from hipsta_bids.derivatives.analyses import GroupResults
from hipsta_bids.reports.group_maps import embedded
from hipsta_bids.reports.page import Section


def _surrogate(results: GroupResults) -> Mapping[str, Any] | None:
    """Show thickness in single slices by group."""
    title = "Surrogate thickness by group"
    pictures = embedded(results, "surrogate", title, f"{title}, with limits of the means")
    text = (
        "Thickness from the medial axis of single slices, without a mesh (`hipsta-bids surrogate`)."
        " Means are not adjusted for covariates. Limits hold at each point, not for whole curves."
    )
    about = {"title": title, "text": text, "file": "surrogate.tsv", "columns": [], "rows": []}
    return {**about, "pictures": pictures} if pictures else None


SECTIONS: tuple[Section[GroupResults], ...] = (
    Section("surrogate", "Surrogate thickness", "group/table.html", _surrogate, after="sections"),
)
