"""Who is in the BIDS dataset itself, whether or not there is a segmentation."""

import re
from pathlib import Path

from hipsta_bids.bids.inputs import InputRequest
from hipsta_bids.bids.scan import subject_folders
from hipsta_bids.errors import InputError

#: Never indexed: nothing in them says who takes part.
_IGNORED = tuple(
    re.compile(rf"^/{name}(/|$)")
    for name in ("derivatives", "sourcedata", "code", "stimuli", r"\.\w+")
)


def list_participants(request: InputRequest) -> frozenset[str]:
    """List the participants of the BIDS dataset.

    From pybids's index where the user gave a place for it (made there on first use); otherwise from
    the names of the folders, as indexing thousands of subjects takes minutes.

    Parameters
    ----------
    request : InputRequest

    Returns
    -------
    frozenset of str
        Labels without ``sub-``.

    Raises
    ------
    InputError
        ``unreadable-database`` if pybids cannot use the index.
    """
    if request.bids_database_dir is None:
        return frozenset(folder.subject for folder in subject_folders(request.bids_dir))
    return _from_index(request.bids_dir, request.bids_database_dir)


def _from_index(bids_dir: Path, database_dir: Path) -> frozenset[str]:
    # Takes seconds to import.
    from bids import BIDSLayout, BIDSLayoutIndexer  # noqa: PLC0415
    from sqlalchemy.exc import SQLAlchemyError  # noqa: PLC0415 (comes with pybids)

    try:
        layout = BIDSLayout(
            bids_dir,
            validate=False,
            derivatives=False,
            database_path=database_dir,
            indexer=BIDSLayoutIndexer(validate=False, index_metadata=False, ignore=_IGNORED),
        )
        made_for = Path(layout.root)
        subjects = frozenset(layout.get_subjects())
    except (OSError, ValueError, TypeError, SQLAlchemyError) as error:
        first_line = str(error).partition("\n")[0]
        raise InputError(
            f"{database_dir}: pybids cannot use this database ({first_line}); "
            "give an empty folder, and it will be made",
            reason="unreadable-database",
        ) from error
    if made_for.resolve() != bids_dir.resolve():
        raise InputError(
            f"{database_dir}: this database was made for {made_for}; give an empty folder",
            reason="unreadable-database",
        )
    return subjects
