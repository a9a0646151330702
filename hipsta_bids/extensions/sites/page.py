"""Section of the page of an analysis: effects of sites."""

from collections.abc import Mapping
from typing import Any

from hipsta_bids.derivatives.analyses import GroupResults, records
from hipsta_bids.reports import cells
from hipsta_bids.reports.group_maps import embedded
from hipsta_bids.reports.page import Section


def harmonization(results: GroupResults) -> Mapping[str, Any] | None:
    """Describe the effects of sites that were removed, and their remains."""
    record = results.record.get("harmonization")
    if not record:
        return None
    alt = "Means and SDs of the residuals of sites over points, before and after harmonization"
    names = (results.record.get("inputs") or {}).get("maps") or {}
    pictures = embedded(results, "sites", "Sites before and after harmonization", alt)
    for name in names:
        caption = f"Sites before and after harmonization, {cells.display_name(name)}"
        pictures += embedded(results, f"{name}_sites", caption, alt)
    sites = results.everywhere("sites")
    settings = (results.record.get("settings") or {}).get("harmonization") or {}
    limit = float(settings.get("explained", 1.0))
    shares = (record.get("explained") or {}).items()
    return {
        **record,
        "rows": records(sites[sites["kind"] == "map"]),
        "pictures": pictures,
        "registered": bool(len(results.table("registration"))),
        "compared": bool(len(results.table("classification"))),
        "doubtful": [(name, share) for name, share in shares if share > limit],
    }


SECTIONS = (
    Section(
        "harmonization",
        "Harmonization",
        "group/harmonization.html",
        harmonization,
        after="registration",
    ),
)
