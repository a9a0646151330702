"""Templates of an analysis as a separate BIDS dataset, which other studies can name."""

import re
from pathlib import Path

from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.names import DATASET_FILES, TEXTS
from hipsta_bids.errors import NothingToDoError, UsageError
from hipsta_bids.io import files
from hipsta_bids.stats.formula import ascii_letters

#: Files of an analysis (pattern), and what follows the label of the template in their names.
_FILES = {
    "hemi-*_desc-average_midthickness.surf.gii": "{hemi}midthickness.surf.gii",
    "template.json": "desc-registration_template.json",
}
_TEMPLATE = f"tpl-*/anat/tpl-*_{_FILES['template.json']}"


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
        files.write_json(sidecar, TEXTS["template"]["sidecar"])
        written.append(sidecar)
    dataset.write_template_notes(root)
    return written


def template_file(path: Path) -> Path:
    """Find the template of registration in a dataset of a template; a file is itself."""
    if not path.is_dir():
        return path
    paths = sorted(path.glob(_TEMPLATE))
    if len(paths) != 1:
        raise UsageError(
            f"--template {path}: has {len(paths)} templates of registration; name the file"
        )
    return paths[0]
