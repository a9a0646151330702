"""Sidecars of surfaces, maps, labels and masks.

What is the same for all hemispheres is said once, in the root of the dataset, by BIDS' inheritance;
what a hemisphere's images come from is said beside them.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hipsta_bids.derivatives.names import OUTPUTS, Output
from hipsta_bids.io import files

#: The sidecars that images of every hemisphere share.
SHARED = tuple(row for row in OUTPUTS if row.images)

#: Where coordinates are, by the name of the space: ``orig`` is that of the segmentation.
_SPACES = {None: "orig", "unfold": "plane in which the sheet is laid flat to scale, mm"}


def write_shared(root: Path) -> None:
    """Write what holds for all hemispheres."""
    for row in SHARED:
        files.write_json(root / row.for_all, describe(row))


def describe(sidecar: Output) -> dict[str, str]:
    """Say what the images of a sidecar are, from the table of outputs."""
    about = {
        "Description": _by_name(sidecar, lambda image: image.description),
        "SpatialReference": _by_name(sidecar, lambda image: _SPACES[image.space]),
        "Units": _by_name(sidecar, lambda image: image.unit or ""),
    }
    if sidecar.suffix == "mask":
        about["Type"] = "ROI"
    return {key: text for key, text in about.items() if text}


def _by_name(sidecar: Output, text_of: Callable[[Output], str]) -> str:
    """Join what is to be said of images that share a sidecar; those without entities come first."""
    names: dict[str, list[str]] = {}
    for image in sidecar.images:
        entity = f"space-{image.space}" if image.space else f"desc-{image.desc}"
        names.setdefault(text_of(image), []).append(entity)
    first, *others = names
    return "; ".join([first, *(f"with {', '.join(names[text])}: {text}" for text in others)])


def sources(record: Mapping[str, Any]) -> list[str]:
    """List the inputs of a quality record, edited ones included, as BIDS addresses."""
    entries = [*(record.get("inputs") or ()), *(record.get("edited") or ())]
    return list(dict.fromkeys(str(entry["file"]) for entry in entries))
