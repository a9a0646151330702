"""Options of maps and volumes of other programs and of masks, and what they read."""

import argparse
from typing import TYPE_CHECKING

from hipsta_bids.cli.parser import Parser, adder, named_pattern

if TYPE_CHECKING:
    from hipsta_bids.group.cohort.sources import Source


def add_options(parser: Parser) -> None:
    """Add the options of maps, volumes and masks."""
    add = adder(parser.add_argument_group("maps and volumes of other programs, and masks"))
    add(
        "--maps",
        "NAME=PATTERN...",
        "maps of other programs (GIFTI, CIFTI, TSV), also without sheets: path, also in "
        "BIDS_DIR, with {subject}, {session}, {hemi} (or {side}), *. CIFTI (.dscalar.nii) has "
        "both sides.",
        type=named_pattern,
    )
    add(
        "--maps-surface",
        "[NAME=]PATTERN...",
        "surfaces (.surf.gii) whose vertices these points are (default: HippUnfold's unfolded"
        " surface beside a map, or the grid of the sheets)",
        type=_maybe_named,
    )
    add(
        "--maps-crop",
        "",
        "crop --maps to the sheets: sample them at the nodes of each participant's sheet, by "
        "surfaces in scanner space",
    )
    add(
        "--volumes",
        "NAME=PATTERN...",
        "tables of volumes (beside segmentations: found anyway): path, also in BIDS_DIR, "
        "with {subject}, {session}, {hemi} or {side}, *",
        type=named_pattern,
    )
    add(
        "--mask",
        "MASK...",
        "grid points to exclude: repaired (by the program), or a table with x, y (node numbers),"
        " perhaps participant_id, session_id, hemi",
    )


def make_sources(parsed: argparse.Namespace) -> "tuple[Source, ...]":
    """Return the sources that the options name, in the order of reading."""
    from hipsta_bids.extensions.maps import sources  # noqa: PLC0415  (heavy)

    return (
        sources.Maps(
            patterns=tuple(parsed.maps),
            surfaces=tuple(parsed.maps_surface),
            crop=parsed.maps_crop,
        ),
        sources.Masks(masks=tuple(parsed.mask)),
        sources.Volumes(patterns=tuple(parsed.volumes)),
    )


def _maybe_named(text: str) -> tuple[str | None, str]:
    name, equals, pattern = text.partition("=")
    return (name, pattern) if equals and name.isalnum() else (None, text)
