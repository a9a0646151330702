"""Part of the page of an analysis: what a joint test is evidence of."""

from collections.abc import Mapping
from typing import Any

from hipsta_bids.derivatives.analyses import GroupResults
from hipsta_bids.reports import cells


def joint_finding(results: GroupResults) -> tuple[str, Mapping[str, Any]] | None:
    """Describe the maps of a joint test, with the template of the description."""
    settings = results.record.get("settings") or {}
    joint = settings.get("joint") or {}
    if not joint.get("measures"):
        return None
    names = [cells.display_name(str(name)) for name in joint["measures"]]
    sides = ["on the left", "on the right"] if joint.get("sides") else []
    title = " and ".join(names) + (f", {' and '.join(sides)}," if sides else "")
    permutations = settings["multiplicity"]["permutations"]
    return "group/joint.html", {**joint, "what": title, "permutations": permutations}
