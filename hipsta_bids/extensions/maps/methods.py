"""Sentences of the methods text on maps of other programs."""

from collections.abc import Iterator, Sequence

from hipsta_bids.extensions.maps.crop import REACH


def map_sentences(surfaces: Sequence[str], cropped: Sequence[str]) -> Iterator[str]:
    """Describe how maps of other programs were brought to points that correspond."""
    if surfaces:
        yield (
            f"Maps of other programs ({', '.join(surfaces)}) were compared point by point, without"
            " registration."
        )
    if cropped:
        yield (
            f"Maps of other programs ({', '.join(cropped)}) were sampled at the nodes of each"
            f" participant's sheet, within {REACH:g} mm of the program's surface in scanner"
            " space. They end at the end planes of the sheet and follow its registration."
        )
