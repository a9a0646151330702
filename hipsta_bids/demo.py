"""The demonstration: a synthetic dataset, and how near the measured thickness is to the truth."""

from collections.abc import Iterator
from pathlib import Path

from hipsta_bids.bids import files
from hipsta_bids.bids.names import HemisphereName, output_path
from hipsta_bids.bids.status import identity, read_status, row_key
from hipsta_bids.phantom import TRUTH_TABLE, refuse_taken, write_demo_dataset

_PROTOCOL = "freesurfer"  # the layout that the demo dataset has


def write_demo_data(folder: Path) -> None:
    """Write the demo dataset, never into a folder that holds something else.

    Parameters
    ----------
    folder : Path
        New, empty, or an earlier demo dataset.

    Raises
    ------
    UsageError
        If the folder holds anything else.
    OutputError
        If it cannot be written.
    """
    refuse_taken(folder, "a demo dataset")
    write_demo_dataset(folder)


def compare_with_truth(data: Path, out: Path) -> Iterator[str]:
    """Set measured beside true mean thickness.

    Parameters
    ----------
    data : Path
        The demo dataset.
    out : Path
        Results of the participant level on it.

    Yields
    ------
    str
        One line per hemisphere.

    Raises
    ------
    InputError
        If the table of true values or a summary cannot be read.
    """
    ended = {row_key(row): row for row in read_status(out)}
    for row in files.read_tsv(data / TRUTH_TABLE):
        name = HemisphereName(
            subject=row["subject"].removeprefix("sub-"),
            session=None,
            hemi=row["hemi"],
            seg=_PROTOCOL,
        )
        title = f"{row['subject']} {row['hemi']} ({row['kind']})"
        status = ended.get(row_key(identity(name)), {}).get("status", "not run")
        true = float(row["thickness_mean"])
        summary = out / output_path(name, "summary")
        if not summary.exists():
            yield f"{title}: true mean thickness {true:.3f} mm, not measured ({status})"
            continue
        (values,) = files.read_tsv(summary)
        measured = float(values["thickness_mean"])
        yield (
            f"{title}: true mean thickness {true:.3f} mm, measured {measured:.3f} mm,"
            f" difference {measured - true:+.3f} mm ({status})"
        )
