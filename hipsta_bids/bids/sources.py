"""Which datasets to search, and in which order."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hipsta_bids.bids.inputs import InputRequest
from hipsta_bids.bids.scan import generators, list_folder, read_description
from hipsta_bids.errors import InputError

LAYOUTS = ("freesurfer", "ashs", "hippunfold", "named")
"""Kinds of folders that can be searched; ``named`` is any ``_hemi-?_..._dseg`` file with names."""

_OURSELVES = "hipsta_bids"


@dataclass(frozen=True, kw_only=True)
class Source:
    """A dataset that may hold segmentations."""

    name: str
    path: Path
    explicit: bool
    """Given by the user, not found by default."""
    layouts: tuple[str, ...] = LAYOUTS
    """Kinds of segmentation to look for here."""
    generators: frozenset[str] = frozenset()
    """Software named in its ``dataset_description.json``."""


def list_sources(request: InputRequest) -> tuple[Source, ...]:
    """List the datasets to search, first come first served.

    What the user names comes first (``-d``, then ``--freesurfer-dir``, ``--ashs-dir`` and
    ``--hippunfold-dir``), then ``BIDS_DIR/derivatives``, ``BIDS_DIR/sourcedata``, and ``BIDS_DIR``
    itself where it is a derivative dataset. Folders of these that hold no ``sub-*`` are searched
    two levels down, and ``sourcedata`` inside of derivatives too (fMRIPrep keeps FreeSurfer's
    folder there). Our own outputs are left out.

    Parameters
    ----------
    request : InputRequest

    Returns
    -------
    tuple of Source

    Raises
    ------
    InputError
        If ``bids_dir`` or a folder that the user gave is missing or cannot be listed.
    """
    sources: dict[Path, Source] = {}
    for source in _candidates(request):
        description = read_description(source.path)
        made_by = generators(description)
        key = source.path.resolve()
        if _OURSELVES not in {name.replace("-", "_") for name in made_by} and key not in sources:
            sources[key] = Source(
                name=source.name,
                path=source.path,
                explicit=source.explicit,
                layouts=source.layouts,
                generators=made_by,
            )
    return tuple(sources.values())


def _candidates(request: InputRequest) -> Iterator[Source]:
    top, _ = list_folder(request.bids_dir)
    for name, path in request.derivatives.items():
        for root in _datasets(path, depth=1) or [path]:
            yield Source(name=name, path=root, explicit=True)
    options = (request.freesurfer_dir, request.ashs_dir, request.hippunfold_dir)
    for layout, option in zip(LAYOUTS, options, strict=False):
        if option is not None:
            for root in _datasets(option, depth=1) or [option]:
                yield Source(name=layout, path=root, explicit=True, layouts=(layout,))
    for folder in ("derivatives", "sourcedata"):
        if folder in top:
            for root in _datasets(request.bids_dir / folder, depth=2, lenient=True):
                yield Source(name=root.name, path=root, explicit=False)
    # A dataset without a description may be a bare folder of subjects.
    description = read_description(request.bids_dir)
    derived = description is None or description.get("DatasetType") == "derivative"
    if derived or generators(description):
        yield Source(name=request.bids_dir.resolve().name, path=request.bids_dir, explicit=False)


def _datasets(root: Path, *, depth: int, lenient: bool = False) -> list[Path]:
    """Find the folders that hold ``sub-*`` folders.

    ``lenient`` leaves out what cannot be listed: nobody asked for it (``sourcedata`` is often
    closed to all but a few).
    """
    try:
        folders, _ = list_folder(root)
    except InputError:
        if lenient:
            return []
        raise
    if any(name.startswith("sub-") for name in folders):
        inner, found, depth = [name for name in folders if name == "sourcedata"], [root], 2
    else:
        inner, found = folders if depth else [], []
    for name in inner:
        found += _datasets(root / name, depth=depth - 1, lenient=lenient)
    return found
