"""Templates of an analysis as a BIDS dataset of their own, which other studies can name."""

import re
from pathlib import Path
from typing import Any

from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.names import DATASET_FILES
from hipsta_bids.errors import NothingToDoError, UsageError
from hipsta_bids.group.output.template import TEMPLATE_ENDING
from hipsta_bids.io import files
from hipsta_bids.joints import read_texts
from hipsta_bids.stats.formula import ascii_letters

#: Files of an analysis (pattern), and what follows the label of the template in their names.
_FILES = {
    "hemi-*_desc-average_midthickness.surf.gii": "{hemi}midthickness.surf.gii",
    "template.json": TEMPLATE_ENDING,
}


def export_template(results: Path, root: Path, name: str | None = None) -> list[Path]:
    """Copy average surfaces and the template of registration into a dataset, by BIDS 1.11.

    ``results`` is the folder of an analysis, ``name`` the label of the template.
    """
    label = name or re.sub(r"[\W_]", "", ascii_letters(results.name, ""))
    if not label.isascii() or not label.isalnum():
        raise UsageError(f"--name {label}: letters and digits only")
    if (root / DATASET_FILES["description"]).exists() and not any(root.glob("tpl-*")):
        raise UsageError(f"{root}: is another dataset; choose a new folder")
    folder, written = root / f"tpl-{label}" / "anat", []
    for pattern, ending in _FILES.items():
        for source in sorted(results.glob(pattern)):
            hemi = source.name[: len("hemi-L_")]
            path = folder / f"tpl-{label}_{ending.format(hemi=hemi)}"
            files.write_bytes(path, source.read_bytes())
            written.append(path)
    if not written:
        raise NothingToDoError(f"{results}: no template; name the folder of an analysis with maps")
    sidecar = folder / f"tpl-{label}_midthickness.json"
    if any(path.suffix == ".gii" for path in written):
        files.write_json(sidecar, _texts()["sidecar"])
        written.append(sidecar)
    _write_notes(root)
    return written


def _write_notes(root: Path) -> None:
    """Write description, README and ``.bidsignore`` of a dataset of templates."""
    texts = _texts()
    about = {
        "Name": texts["name"],
        "BIDSVersion": dataset.BIDS_VERSION,
        "DatasetType": "derivative",
    }
    files.write_json(
        root / DATASET_FILES["description"], about | {"GeneratedBy": [dataset.describe_maker()]}
    )
    files.write_text(root / DATASET_FILES["readme"], texts["readme"])
    files.write_text(root / DATASET_FILES["ignore"], texts["ignored"])


def _texts() -> dict[str, Any]:
    texts: dict[str, Any] = read_texts("hipsta_bids.extensions.export")["template"]
    return texts
