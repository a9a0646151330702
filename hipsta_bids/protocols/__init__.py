"""Segmentation protocols: one TOML file each."""

#: Regions with the head on the sheet: with the tail or without it. Here, where the command line and
#: names of files find them without loading protocols.
EXPERIMENTAL = ("headbody", "whole")


def rows_beyond(region: str, rows: int) -> tuple[int, int]:
    """Count the rows of a grid behind and before the body's ``rows``: for the tail and the head."""
    head = rows - 1 if region in EXPERIMENTAL else 0
    return (head // 2 if region == "whole" else 0), head
