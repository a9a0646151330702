"""What survives when many points are tested: false discovery rate, or permutations."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError
from hipsta_bids.group.fitted import FittedMaps
from hipsta_bids.group.mesh_graph import mesh_edges
from hipsta_bids.group.multiplicity import BELOW_ALL, Discoveries, MapKey, discover, families
from hipsta_bids.group.permutation import PermutationPart, PermutationTest, permute
from hipsta_bids.group.row_model import RowModel
from hipsta_bids.group.variables import check_names, listed
from hipsta_bids.group_data import Float, Int
from hipsta_bids.group_settings import GroupSettings, MultiplicitySettings

#: Methods that hold the family-wise error rate.
PERMUTATIONS = ("permutation-tfce", "permutation-max")


def correct(
    fitted: Mapping[str, FittedMaps], model: RowModel, table: pd.DataFrame, settings: GroupSettings
) -> dict[MapKey, Discoveries]:
    """Tell which points survive, in families.

    Parameters
    ----------
    fitted : mapping of str to FittedMaps
        By hemisphere.
    model : RowModel
        That was fitted.
    table : DataFrame
        Rows of the model, with the column of blocks.
    settings : GroupSettings
        Method, level, family, permutations.

    Raises
    ------
    ModelError
        If permutations do not go with the model, or blocks are unknown or missing.
    """
    how = settings.multiplicity
    tests = {
        MapKey(measure, test.contrast.name, hemi): test
        for hemi, one in fitted.items()
        for measure, fit in one.fits.items()
        for test in fit.tests
    }
    if how.method not in PERMUTATIONS:
        return discover({key: test.p for key, test in tests.items()}, how)
    check_permutations(model, settings)
    blocks = _blocks(model, table, how)
    found: dict[MapKey, Discoveries] = {}
    for keys in families(tests, how.scope):
        parts = [_part(fitted[key.hemi], key.measure, model) for key in keys]
        shape = fitted[keys[0].hemi].maps.shape
        results = permute(parts, tests[keys[0]].contrast, shape, settings=how, blocks=blocks)
        raw = [tests[key].p for key in keys]
        found |= dict(zip(keys, _discoveries(results, raw, how), strict=True))
    return {key: found[key] for key in tests}


def check_permutations(model: RowModel, settings: GroupSettings) -> None:
    """Refuse permutations where rows cannot be exchanged.

    Raises
    ------
    ModelError
        For mixed models, and for unequal variances.
    """
    if settings.multiplicity.method not in PERMUTATIONS:
        return
    if model.participants is not None:
        raise ModelError(
            "permutations: visits of the same participant cannot be exchanged with those of"
            " others; use --correction fdr2, or --paired",
            reason="permutation-model",
        )
    if settings.glm.covariance != "ordinary":
        raise ModelError(
            "permutations assume equal variances; set glm.covariance to ordinary",
            reason="permutation-model",
        )


def _blocks(model: RowModel, table: pd.DataFrame, how: MultiplicitySettings) -> Int | None:
    """Give the number of each row's block."""
    if not how.blocks:
        return None
    check_names([how.blocks], table.columns)
    own = table[how.blocks].iloc[model.design.rows]
    if own.isna().any():
        raise ModelError(
            f"permutations: column {how.blocks!r} of --blocks is missing for"
            f" {listed(own.index[own.isna()])}",
            reason="permutation-blocks",
        )
    return np.asarray(np.unique(own.astype(str), return_inverse=True)[1], dtype=np.int64)


def _part(one: FittedMaps, measure: str, model: RowModel) -> PermutationPart:
    mesh = one.maps.mesh
    edges = None if mesh is None else mesh_edges(mesh.triangles)
    return PermutationPart(one.values(measure), model.design.matrix[one.rows], one.rows, edges)


def _discoveries(
    results: Sequence[PermutationTest], raw: Sequence[Float], how: MultiplicitySettings
) -> list[Discoveries]:
    enhanced = how.method == "permutation-tfce"
    corrected = [one.p_enhanced if enhanced else one.p_max for one in results]
    rejected = [p <= how.alpha for p in corrected]
    n_tests = sum(int(np.isfinite(p).sum()) for p in corrected)
    cutoff = np.nan
    if n_tests and not enhanced:
        own, survive = np.concatenate(raw), np.concatenate(rejected)
        cutoff = own[survive].max() if survive.any() else np.nanmin(own) * BELOW_ALL
    return [
        Discoveries(p, flags, float(cutoff), n_tests, n_tests, how.alpha)
        for p, flags in zip(corrected, rejected, strict=True)
    ]
