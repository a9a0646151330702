"""Norms of several sites become one, by sums over their participants."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids import __version__
from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.extensions.norms import sums as summed_norms
from hipsta_bids.extensions.norms.file import NormsFile, load_norms, save_norms
from hipsta_bids.extensions.norms.settings import NormSettings
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.stats.formula import listed

#: File of norms, in the folder of an analysis.
NORMS = "norms.json"
#: Entries that the norms of all sites have in common.
_COMMON = (
    *("seg", "region", "settings_hash", "registration", "template", "x", "y"),
    *("age", "sex", "site", "sexes", "knots"),
)


def _shared_maps(
    sums_of_files: Sequence[Mapping[tuple[str, str], Any]],
) -> tuple[list[tuple[str, str]], list[str]]:
    """List the maps, by hemisphere and name, that all files have, and note the others."""
    shared = [key for key in sums_of_files[0] if all(key in sums for sums in sums_of_files)]
    omitted = sorted({name for sums in sums_of_files for _, name in set(sums) - set(shared)})
    note = f"not all sites have norms of {listed(omitted)}, which are omitted"
    return shared, [note] * bool(omitted)


def _labels(loaded: Sequence[NormsFile]) -> dict[str, list[str]]:
    """Return all kinds of labels in the norms of some sites."""
    names = dict.fromkeys(name for file in loaded for name in file.labels)
    return {n: sorted({x for file in loaded for x in file.labels.get(n, ())}) for n in names}


def merge_norms(
    paths: Sequence[Path], out_dir: Path, settings: GroupSettings
) -> tuple[Path, list[str]]:
    """Merge the norms of sites; returns the file and notes."""
    paths = [path / NORMS if path.is_dir() else path for path in paths]
    loaded = [load_norms(path)[0] for path in paths]
    _check_agreement(paths, loaded)
    first, sites = loaded[0], {name: n for file in loaded for name, n in file.sites.items()}
    least, participants = settings.of(NormSettings).least_participants, sum(sites.values())
    if participants < least:
        raise ModelError(
            f"meta --norms: {participants} participants, {least} are needed; add sites"
        )
    sums_of_files = [file.site_sums() for file in loaded]
    shared, notes = _shared_maps(sums_of_files)
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
        "labels": _labels(loaded),
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
