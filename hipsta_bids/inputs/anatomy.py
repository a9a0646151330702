"""Anatomical images to be shown behind labels: which file each kind of segmentation goes with.

A picture of labels on an image from another space misleads, so only these are taken:

- FreeSurfer: ``norm.mgz``, else ``brain.mgz``, of the same ``mri`` folder;
- ASHS: the T2-weighted image that it segmented, ``tse.nii.gz`` or one with that ending, beside the
  segmentation or in the folder above ``final``;
- any other: a T1w or T2w image beside the labels or of the same visit in the BIDS dataset, if its
  space is that in the name of the labels (HippUnfold's ``space-cropT1w``), or if it has the same
  grid of voxels.
"""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hipsta_bids.errors import InputError
from hipsta_bids.inputs import ashs, freesurfer
from hipsta_bids.inputs.scan import list_folder
from hipsta_bids.io.files import entities
from hipsta_bids.types import Hemisphere

_FREESURFER = ("norm.mgz", "brain.mgz")
_ASHS = re.compile(r"(?:.+_)?tse(?:_native_chunk_(?P<side>left|right))?\.nii(?:\.gz)?")
_SIDES = {"L": "left", "R": "right"}
#: T2-weighted images, which show the subfields, before others.
_SUFFIXES = ("T2w", "T1w")
_IMAGES = {".nii.gz", ".nii", ".mgz"}


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """An image that may be in the space of the labels."""

    path: Path
    proven: bool
    """Its place or name says that it is in this space; else only the same grid of voxels does."""


def find_anatomy(labels: Path, hemisphere: Hemisphere, bids_dir: Path) -> Iterator[Candidate]:
    """List anatomical images that may lie behind a hemisphere's labels, best first, unopened."""
    if freesurfer.volume_table(labels) is not None:
        for name in _FREESURFER:
            if (path := labels.with_name(name)).is_file():
                yield Candidate(path=path, proven=True)
        return
    if ashs.volume_table(labels) is not None:
        folder = labels.parent
        for place in (folder, folder.parent) if folder.name == "final" else (folder,):
            for name in _names(place):
                match = _ASHS.fullmatch(name)
                if match and match["side"] in (None, _SIDES[hemisphere.hemi]):
                    yield Candidate(path=place / name, proven=True)
    visit = bids_dir / f"sub-{hemisphere.subject}"
    if hemisphere.session is not None:
        visit /= f"ses-{hemisphere.session}"
    yield from _named(labels, hemisphere, (labels.parent, visit / "anat"))


def _named(labels: Path, hemisphere: Hemisphere, folders: tuple[Path, ...]) -> Iterator[Candidate]:
    """List T1w and T2w images in some folders, those in the space of the labels first."""
    space = entities(labels.name).get("space", "")
    # HippUnfold's crops lie in the space of the whole image.
    whole = space.removeprefix("crop")
    images = []
    for folder in dict.fromkeys(folders):
        for name in _names(folder):
            pairs = entities(name)
            if (
                pairs["suffix"] in _SUFFIXES
                and pairs["extension"] in _IMAGES
                and pairs.get("hemi", hemisphere.hemi) == hemisphere.hemi
                and pairs.get("sub", hemisphere.subject) == hemisphere.subject
                and pairs.get("ses", hemisphere.session) == hemisphere.session
            ):
                # An image whose name has no space is in its own.
                image_space = pairs.get("space", pairs["suffix"])
                images.append((folder / name, image_space, pairs["suffix"]))
    counts = Counter((path.parent, image_space) for path, image_space, _ in images)

    def rank(entry: tuple[Path, str, str]) -> tuple[bool, bool, int]:
        _, image_space, suffix = entry
        return image_space != space, image_space != whole, _SUFFIXES.index(suffix)

    for path, image_space, _ in sorted(images, key=rank):
        # Of several runs, the name does not say in whose space the labels are.
        proven = (
            bool(space) and image_space in (space, whole) and counts[path.parent, image_space] == 1
        )
        yield Candidate(path=path, proven=proven)


def _names(folder: Path) -> tuple[str, ...]:
    """List the files of a folder by name; none where it cannot be listed."""
    try:
        return tuple(sorted(list_folder(folder)[1]))
    except InputError:
        return ()
