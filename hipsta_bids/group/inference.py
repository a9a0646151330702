"""What survives when many points are tested: false discovery rate, or permutations."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from statsmodels.stats.multitest import multipletests

from hipsta_bids.errors import ModelError
from hipsta_bids.group.clusters import edges_of
from hipsta_bids.group.data import Bool, Float, Int
from hipsta_bids.group.formula import check_names, listed
from hipsta_bids.group.glm import FittedMaps, RowModel
from hipsta_bids.group.permutation import PermutationPart, PermutationTest, permute
from hipsta_bids.group.settings import GroupSettings, MultiplicitySettings

#: Share of the smallest p that serves as cut-off when nothing is rejected.
BELOW_ALL = 0.1
#: Methods that hold the family-wise error rate.
PERMUTATIONS = ("permutation-tfce", "permutation-max")


@dataclass(frozen=True)
class Discoveries:
    """Tests that survive, in the shape of the p-values."""

    adjusted: Float
    """Compare with ``alpha``; of false discovery rates it holds for this level. NaN where there
    was no test."""
    rejected: Bool
    cutoff: float
    """Largest raw p that is rejected; a tenth of the smallest p if none is (the convention of
    FreeSurfer's ``lme_mass_FDR``), so that nothing lies at or below it; NaN without tests,
    and where clusters decide."""
    n_tests: int
    alpha: float

    @property
    def lenient(self) -> bool:
        """Whether raw p-values above ``alpha`` pass, as they may when effects are widespread."""
        return bool(self.rejected.any()) and self.cutoff > self.alpha


def control_fdr(p: Float, alpha: float, method: str = "fdr2") -> Discoveries:
    """Control the false discovery rate of tests; NaN is no test.

    ``bh`` is the step-up procedure of Benjamini and Hochberg (1995), ``fdr2`` the two-stage one of
    Benjamini, Krieger and Yekutieli (2006): the first stage, at ``alpha / (1 + alpha)``, estimates
    how many null hypotheses are true, and the second allows for that number only.
    """
    valid = np.isfinite(p)
    tests = p[valid]
    adjusted, rejected, cutoff = np.full(p.shape, np.nan), np.zeros(p.shape, dtype=bool), np.nan
    if len(tests):
        name = "fdr_bh" if method == "bh" else "fdr_tsbky"
        rejected[valid], adjusted[valid], *_ = multipletests(tests, alpha, name)
        cutoff = tests[rejected[valid]].max() if rejected.any() else tests.min() * BELOW_ALL
    return Discoveries(adjusted, rejected, float(cutoff), len(tests), alpha)


@dataclass(frozen=True, order=True)
class MapKey:
    """Which map of statistics."""

    measure: str
    contrast: str
    hemi: str


def families(maps: Iterable[MapKey], scope: str) -> list[list[MapKey]]:
    """Group maps whose points are tested together."""
    found: dict[tuple[str, ...], list[MapKey]] = {}
    for key in maps:
        family = (key.measure, key.contrast, *(() if scope == "hemispheres" else (key.hemi,)))
        found.setdefault(family, []).append(key)
    return list(found.values())


def discover(
    maps: Mapping[MapKey, Float], settings: MultiplicitySettings
) -> dict[MapKey, Discoveries]:
    """Control the false discovery rate of several maps (points,), in families."""
    found = {}
    for keys in families(maps, settings.scope):
        p = np.concatenate([maps[key] for key in keys])
        together = control_fdr(p, settings.alpha, settings.method)
        ends = np.cumsum([len(maps[key]) for key in keys])[:-1]
        adjusted, rejected = np.split(together.adjusted, ends), np.split(together.rejected, ends)
        for key, values, flags in zip(keys, adjusted, rejected, strict=True):
            found[key] = replace(together, adjusted=values, rejected=flags)
    return {key: found[key] for key in maps}


def correct(
    fitted: Mapping[str, FittedMaps], model: RowModel, table: pd.DataFrame, settings: GroupSettings
) -> dict[MapKey, Discoveries]:
    """Tell which points survive, in families."""
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
        parts = [
            PermutationPart(
                maps=one.values(key.measure),
                matrix=model.design.matrix[one.rows],
                subjects=one.rows,
                edges=edges_of(one.maps, how.neighbors),
            )
            for key in keys
            for one in [fitted[key.hemi]]
        ]
        results = permute(parts, tests[keys[0]].contrast, settings=how, blocks=blocks)
        raw = [tests[key].p for key in keys]
        found |= dict(zip(keys, _permuted_discoveries(results, raw, how), strict=True))
    return {key: found[key] for key in tests}


def check_permutations(model: RowModel, settings: GroupSettings) -> None:
    """Refuse permutations where rows cannot be exchanged."""
    if settings.multiplicity.method not in PERMUTATIONS:
        return
    if not model.independent:
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
    """Return the number of each row's block, or None without blocks."""
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


def _permuted_discoveries(
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
        Discoveries(p, flags, float(cutoff), n_tests, how.alpha)
        for p, flags in zip(corrected, rejected, strict=True)
    ]
