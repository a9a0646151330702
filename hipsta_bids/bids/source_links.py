"""From the addresses in quality records back to the segmentations on disk."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlsplit

from hipsta_bids.bids import files


def locate_sources(sources: Sequence[str], roots: Sequence[Path]) -> list[Path | None]:
    """Resolve addresses of segmentations.

    Parameters
    ----------
    sources : sequence of str
        ``bids:<dataset>:<path in it>``, or a plain path.
    roots : sequence of Path
        Output dataset that each is from; its description knows where the datasets are.

    Returns
    -------
    list of Path or None
        ``None`` where the address names no known dataset. Files may be gone.
    """
    links: dict[Path, Mapping[str, str]] = {}
    result = []
    for source, root in zip(sources, roots, strict=True):
        if root not in links:
            links[root] = files.read_json(root / "dataset_description.json").get("DatasetLinks", {})
        result.append(_resolve(source, links[root]))
    return result


def relocate(source: str, folders: Sequence[Path]) -> str:
    """Find a segmentation in folders where it may be now.

    Parameters
    ----------
    source : str
        ``bids:<dataset>:<path in it>``, or a plain path.
    folders : sequence of Path
        Datasets that may hold it, in order of preference.

    Returns
    -------
    str
        Its plain path there; the address as it was if none of them has the subject.
    """
    if not source.startswith("bids:"):
        return source
    inside = PurePosixPath(source.split(":", 2)[2])
    for folder in folders:
        # The image itself is not needed, only the subject's folder, for what lies beside it.
        if (folder / inside.parts[0]).is_dir():
            return str(folder / inside)
    return source


def _resolve(source: str, links: Mapping[str, str]) -> Path | None:
    if not source.startswith("bids:"):
        return Path(source) if source else None
    _, dataset, inside = source.split(":", 2)
    link = links.get(dataset, "")
    return Path(unquote(urlsplit(link).path)) / inside if link.startswith("file:") else None
