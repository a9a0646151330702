"""Segmentation protocols: one TOML file each."""

from hipsta_bids.joints import find_regions

#: Regions with the head on the sheet, of extensions. Here, where the command line and names of
#: files find them without loading protocols.
EXPERIMENTAL = tuple(find_regions())


def rows_beyond(region: str, rows: int) -> tuple[int, int]:
    """Count the rows of a grid behind and before the body's ``rows``: for the tail and the head."""
    head = rows - 1 if region in EXPERIMENTAL else 0
    return (head // 2 if region == "whole" else 0), head


def body_ends(region: str, rows: int) -> tuple[int, int] | None:
    """First and last row of the body on a grid with ``rows``; ``None`` if there are no others."""
    for body in range(rows if region in EXPERIMENTAL else 0, 1, -1):
        tail, head = rows_beyond(region, body)
        if tail + body + head == rows:
            return tail, tail + body - 1
    return None
