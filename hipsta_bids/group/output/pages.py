"""Pages of results, made from their files when these are complete."""

from pathlib import Path

from hipsta_bids.derivatives.names import group_report
from hipsta_bids.io import files
from hipsta_bids.progress import tell
from hipsta_bids.reports.comparison import write_comparison_report
from hipsta_bids.reports.group import write_group_report


def write_page(out_dir: Path, name: str, *, reports: bool) -> tuple[Path | None, str | None]:
    """Write the page of an analysis; return its path, or why it could not be made."""
    path = out_dir / group_report(name)
    if not reports:
        files.remove([path])  # it would be that of an earlier analysis of this name
        return None, None
    tell("page")
    problem = write_group_report(out_dir, name)
    return (path if problem is None else None), problem


def write_comparison_page(folder: Path, *, reports: bool) -> None:
    """Write the page of a comparison next to its folder."""
    files.remove([folder.with_name(f"{folder.name}.html")])  # it may be that of an earlier one
    if reports:
        write_comparison_report(folder)
