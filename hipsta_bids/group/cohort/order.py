"""The order of visits: participants as they are, and the sessions of each by time or number."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd

from hipsta_bids.group.cohort.collect import Collection
from hipsta_bids.group.cohort.covariates import Spellings, order_sessions, read_covariates
from hipsta_bids.group.cohort.read import table_of, visit_name
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.types import VisitKey


def read_in_order(
    collection: Collection,
    visits: Sequence[VisitKey],
    bids_dir: Path,
    extra: Sequence[Path],
    settings: GroupSettings,
) -> tuple[Collection, list[VisitKey], tuple[pd.DataFrame, frozenset[str], Spellings]]:
    """Read covariates, and sort hemispheres, visits and covariates by the order of the sessions."""
    table, absent, spelled = read_covariates(table_of(visits), bids_dir, extra, settings)
    sessions = order_sessions(table, settings)
    subjects = list(dict.fromkeys(subject for subject, _ in visits))
    people = {subject: i for i, subject in enumerate(subjects)}
    rank = {name: i for i, name in enumerate(sessions)}
    ordered = sorted(visits, key=lambda key: (people[key[0]], rank.get(f"ses-{key[1]}", -1)))
    place = {visit: i for i, visit in enumerate(ordered)}
    records = sorted(collection.records, key=lambda record: place[record.visit])
    rows = table.loc[[visit_name(*visit) for visit in ordered]]
    return replace(collection, records=tuple(records)), ordered, (rows, absent, spelled)
