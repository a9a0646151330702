"""Norms of several sites become one, by sums over their participants."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids import __version__
from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.output.saved import NormsFile, load_norms, save_norms
from hipsta_bids.group.questions import study as studies
from hipsta_bids.group.questions.disclosure import check_sums, is_traceable
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.stats import summed_norms
from hipsta_bids.stats.arrays import Float, Int, Key
from hipsta_bids.stats.formula import level_labels, listed, typed
from hipsta_bids.stats.norms import People
from hipsta_bids.types import PARTICIPANT

#: File of norms, in the folder of an analysis.
NORMS = "norms.json"
#: Entries that the norms of all sites have in common.
_COMMON = (
    *("seg", "region", "settings_hash", "registration", "template", "x", "y"),
    *("age", "sex", "site", "sexes", "knots"),
)


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
    columns, limits = summed_norms.columns_of(summed, knots), study.settings.exchange
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


def merge_norms(
    paths: Sequence[Path], out_dir: Path, settings: GroupSettings
) -> tuple[Path, list[str]]:
    """Merge the norms of sites; returns the file and notes."""
    paths = [path / NORMS if path.is_dir() else path for path in paths]
    loaded = [load_norms(path)[0] for path in paths]
    _check_agreement(paths, loaded)
    first, sites = loaded[0], {name: n for file in loaded for name, n in file.sites.items()}
    least, participants = settings.norms.least_participants, sum(sites.values())
    if participants < least:
        raise ModelError(
            f"meta --norms: {participants} participants, {least} are needed; add sites"
        )
    sums_of_files = [file.site_sums() for file in loaded]
    shared = [key for key in sums_of_files[0] if all(key in sums for sums in sums_of_files)]
    omitted = {name for sums in sums_of_files for _, name in set(sums) - set(shared)}
    notes = [f"not all sites have norms of {listed(sorted(omitted))}, which are omitted"] * bool(
        omitted
    )
    columns = np.concatenate([np.array(file.columns) for file in loaded])
    norms, nested = {}, dict[str, dict[str, Any]]()
    for hemi, name in shared:
        values = [sums[hemi, name] for sums in sums_of_files]
        if len({array.shape[3] for array in values}) > 1:
            raise ModelError(f"meta --norms: points of {name}, {hemi}, differ; use one grid")
        joined = np.concatenate(values)
        norms[hemi, name] = summed_norms.fit_sums(columns, joined, np.array(first.knots))
        nested.setdefault(hemi, {})[name] = files.plain(joined)
    update = {
        "version": __version__,
        "versions": sorted({version for file in loaded for version in file.versions}),
        "labels": {
            name: sorted({value for file in loaded for value in file.labels.get(name, ())})
            for name in dict.fromkeys(name for file in loaded for name in file.labels)
        },
        "sites": sites,
        "participants": participants,
        "columns": columns.tolist(),
        "sums": nested,
    }
    out_dir.mkdir(parents=True, exist_ok=True)
    save_norms(out_dir / NORMS, first.model_copy(update=update), norms)
    return out_dir / NORMS, notes


def _check_agreement(paths: Sequence[Path], loaded: Sequence[NormsFile]) -> None:
    """Refuse norms without sums, of the same site, or of other measurements."""
    if len(loaded) < 2:  # noqa: PLR2004 -- sites
        raise UsageError("meta --norms: give the norms of two sites or more")
    names: set[str] = set()
    for path, file in zip(paths, loaded, strict=True):
        if not file.columns:
            raise ModelError(f"{path}: has no sums; fit these norms with norms.shared_knots")
        for name in _COMMON:
            if getattr(file, name) != getattr(loaded[0], name):
                raise ModelError(f"{path}: {name} differs from {paths[0]}; all sites need the same")
        if repeated := sorted(names & set(file.sites)):
            raise ModelError(f"{path}: {file.site} {listed(repeated)} is in two files; rename it")
        names |= set(file.sites)
