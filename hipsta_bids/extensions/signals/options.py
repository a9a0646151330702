"""The options of volumes and regions."""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

from hipsta_bids.cli.parser import Parser, adder, named_pattern


def add_options(parser: Parser) -> None:
    """Add the options."""
    add = adder(parser.add_argument_group("what else to bring to the sheet"))
    add(
        "--map",
        "NAME=PATTERN...",
        "volumes in the space of the labels: path (also in BIDS_DIR) with {subject}, {hemi}, *",
        type=named_pattern,
    )
    places = ("depth", "mid", "interior", "exterior")
    add(
        "--map-sampling",
        "[NAME=]" + "|".join(places) + "...",
        "mean from wall to wall (default), on the mid-surface, or on a wall",
        type=_choice(*places),
    )
    add(
        "--map-interpolation",
        "[NAME=]linear|nearest...",
        "between voxels (default: linear); nearest for labels",
        type=_choice("linear", "nearest"),
    )
    add(
        "--map-transform",
        "NAME=PATTERN...",
        "registration of a volume of another space to the labels: ITK (.txt, .tfm, .mat, .h5, "
        ".nii.gz), LTA, or FSL's .mat",
        type=named_pattern,
    )
    add(
        "--map-reference",
        "NAME=PATTERN...",
        "for FSL's matrices: the image that the volume was registered to",
        type=named_pattern,
    )
    add(
        "--roi",
        "FILE.tsv",
        "regions drawn on the sheet: columns x, y, region; a table has their means",
    )


def _choice(*values: str) -> Callable[[str], tuple[str | None, str]]:
    """Return a converter that takes one of some words, for all maps or (NAME=) for one."""

    def convert(text: str) -> tuple[str | None, str]:
        name, equals, value = text.rpartition("=")
        if value not in values or (equals and not name):
            raise argparse.ArgumentTypeError(
                f"{text!r} is not {', '.join(values[:-1])} or {values[-1]}, alone or after NAME="
            )
        return name or None, value

    return convert


def find_files(options: argparse.Namespace) -> Callable[..., Any]:
    """Check the options; return a function of inputs that adds their files."""
    from hipsta_bids.extensions.signals.inputs import attach, map_requests  # noqa: PLC0415  (heavy)

    requests = map_requests(
        *(options.map, options.map_sampling, options.map_interpolation),
        *(options.map_transform, options.map_reference),
    )
    return partial(attach, requests=requests, regions=options.roi, bids_dir=options.bids_dir)
