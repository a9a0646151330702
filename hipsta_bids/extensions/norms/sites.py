"""Sums over the participants of each site, by which norms of several sites become one."""

from collections.abc import Mapping
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.norms import sums as summed_norms
from hipsta_bids.extensions.norms.centiles import People
from hipsta_bids.extensions.norms.file import NormsFile
from hipsta_bids.group.questions import study as studies
from hipsta_bids.io import files
from hipsta_bids.stats.arrays import Float, Int, Key
from hipsta_bids.stats.disclosure import check_sums, is_traceable
from hipsta_bids.stats.formula import level_labels, typed
from hipsta_bids.stats.settings import ExchangeSettings
from hipsta_bids.types import PARTICIPANT


def with_sums(
    study: studies.Study,
    file: NormsFile,
    people: People,
    values: Mapping[Key, tuple[Int, Float]],
) -> tuple[NormsFile, People, dict[Key, tuple[Int, Float]]]:
    """Add the sums of each site; ModelError if a sum could be traced to few participants.

    All sums are about the same participants, who have all hemispheres, so that no difference of two
    sums is about fewer. A point that a participant of a site lacks, or that could be traced, has no
    sums at that site.
    """
    table, knots = study.cohort.table, np.array(file.knots)
    complete = np.flatnonzero(people.known)
    rows: Int = reduce(np.intersect1d, (rows for rows, _ in values.values()), complete)
    lacking = {"a hemisphere or map": map(str, table.index[np.setdiff1d(complete, rows)])}
    study.left_out.update(study.incomplete(lacking, table[PARTICIPANT]))
    common = {
        key: (rows, np.asarray(numbers[np.isin(at, rows)], dtype=np.float64))
        for key, (at, numbers) in values.items()
    }
    members, summed = table.iloc[rows], people.take(rows)
    variables = {file.age: typed(members[file.age])}
    if file.sexes:
        variables[file.sex] = level_labels(members[file.sex])
    names = ["constant", *(f"{file.age} {i}" for i in range(1, len(knots))), *file.sexes[1:]]
    columns, limits = summed_norms.columns_of(summed, knots), study.settings.of(ExchangeSettings)
    for number, site in enumerate(file.sites):
        positions = np.flatnonzero(summed.site == number)
        if len(positions) < limits.min_cell:
            raise ModelError(
                f"--fit-norms, {file.site} {site}: {len(positions)} participants have all maps and"
                f" hemispheres, at least {limits.min_cell} are needed"
            )
        people_here = {name: column.iloc[positions] for name, column in variables.items()}
        models, weights = [(columns[positions], names)], [columns[positions, 1]]
        try:
            cells = check_sums(models, {file.sex}, people_here, limits, weights=weights)
        except ModelError as error:
            problem = str(error).replace("--export-summary", f"--fit-norms, {file.site} {site}")
            raise ModelError(problem) from error
        for _, numbers in common.values():
            hidden = np.flatnonzero(is_traceable(numbers[positions], cells, limits.min_cell))
            numbers[np.ix_(positions, hidden)] = np.nan
    counts = np.bincount(summed.site, minlength=len(file.sites)).tolist()
    sums: dict[str, dict[str, Any]] = {}
    for (hemi, measure), (_, numbers) in common.items():
        sums.setdefault(hemi, {})[measure] = files.plain(
            summed_norms.sum_values(numbers, summed, len(counts), knots)
        )
    update = {
        "sites": dict(zip(file.sites, counts, strict=True)),
        "participants": len(rows),
        "columns": summed_norms.sum_columns(summed, len(counts), knots).tolist(),
        "sums": sums,
    }
    site_of = np.full(len(people.site), -1)
    site_of[rows] = summed.site
    return file.model_copy(update=update), replace(people, site=site_of), common
