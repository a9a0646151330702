"""What survives when many points are tested: false discovery rate, or permutations of residuals."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import pandas as pd
from scipy import special
from statsmodels.stats.multitest import multipletests

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import arrays, exchangeability, glm
from hipsta_bids.stats.arrays import Bool, Float, Int
from hipsta_bids.stats.clusters import edges_of, enhance
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.formula import check_names, listed
from hipsta_bids.stats.glm import FittedMaps, RowModel
from hipsta_bids.stats.settings import GlmSettings, MultiplicitySettings
from hipsta_bids.types import FAMILY

#: Share of the smallest p that serves as cut-off when nothing is rejected.
BELOW_ALL = 0.1
#: Methods that hold the family-wise error rate.
PERMUTATIONS = ("permutation-tfce", "permutation-max")
#: Permutations whose maps a processor has in memory at once, and random numbers for them, if these
#: are more; does not change a result.
_BATCH, _KEYS = 50, 1_000_000
#: Permuted residuals in memory at once where designs differ by point; does not change a result.
_VALUES = 4_000_000
#: Processors that permute; does not change a result.
PROCESSORS: ContextVar[int] = ContextVar("processors", default=1)
#: Sums in another order differ by less, relatively.
_ROUNDING = 1e-9
#: Takes the number of permutations that are done, and of all.
Report = Callable[[int, int], None]
#: The method that does without cluster enhancement.
_MAXIMUM = "permutation-max"


@dataclass(frozen=True)
class PermutationTest:
    """Corrected p-values; the family is all points of all parts."""

    p_uncorrected: Float
    """(points,) of each point alone."""
    p_max: Float
    """(points,) of the statistic itself (maximum over the sheet)."""
    p_enhanced: Float
    """(points,) of the cluster-enhanced statistic; NaN with ``permutation-max``."""
    statistic: Float
    """(points,) t, or F."""


@dataclass(frozen=True, eq=False)
class PermutationPart:
    """Maps of one sheet, as of one hemisphere."""

    maps: Float
    """(subjects, points) NaN is missing."""
    matrix: Float
    """(subjects, columns) design of full column rank."""
    subjects: Int
    """(subjects,) which ones of the whole sample they are: the same subject is shuffled in the
    same way in all parts."""
    edges: Int
    """(edges, 2) neighbors among the points."""
    visits: exchangeability.Visits | None = None
    """Whose each row is, where they are visits of which participants have several."""
    covariates: Float | None = None
    """(maps, subjects, points) further columns of the design at each point."""


def permute(
    parts: Sequence[PermutationPart | Sequence[PermutationPart]],
    contrast: Contrast,
    *,
    settings: MultiplicitySettings,
    blocks: Int | None = None,
    report: Callable[[int], None] | None = None,
    combine: str | None = None,
) -> list[PermutationTest]:
    """Permutation test of one contrast at all points (Freedman and Lane 1983).

    The effect of the covariates is subtracted, the residuals are shuffled between subjects, and
    the whole model is fitted to them again (Winkler et al. 2014). If the contrast tests a mean of
    all subjects (an intercept), signs are flipped instead of subjects shuffled. Of repeated visits
    participants change places with all their visits, or visits with each other, or the signs of all
    visits of a participant are flipped, as the contrast allows
    (:func:`hipsta_bids.stats.exchangeability.choose_exchange`; Winkler et al. 2015).

    Missing values count as the prediction of the covariates, which shrinks an effect; degrees of
    freedom count the subjects present. ``report`` takes the number of permutations that are done.

    Parts of several measures, or sides, at the same points are shuffled alike, which keeps their
    dependence, and combined at each point by :func:`combine_evidence` (non-parametric combination;
    Winkler et al. 2016), whose method is ``combine``.
    """
    groups = [[part] if isinstance(part, PermutationPart) else part for part in parts]
    runs = [_Run(group, contrast, settings, blocks, combine) for group in groups]
    parts_alone = [part for group in groups for part in group]
    subjects = [part.subjects for part in parts_alone]
    subjects += [part.visits.people for part in parts_alone if part.visits]
    n_subjects = 1 + max(int(numbers.max()) for numbers in subjects)
    batch = min(_BATCH, max(_KEYS // n_subjects, 1))

    def reached(start: int) -> list[Float]:
        """Count what reaches the observed statistics, with the keys of a batch by its number."""
        bits = np.random.PCG64(settings.seed).advance((start - 1) * n_subjects)
        count = min(batch, settings.permutations - start)
        keys = np.random.Generator(bits).random((count, n_subjects))
        maps = [run.shuffled(keys) for run in runs]
        highest = np.max([_maximum(t) for t, _ in maps], axis=0)
        highest_enhanced = np.max([_maximum(enhanced) for _, enhanced in maps], axis=0)
        pairs = zip(runs, maps, strict=True)
        return [run.reached(t, highest, highest_enhanced) for run, (t, _) in pairs]

    starts = range(1, settings.permutations, batch)
    with ThreadPoolExecutor(PROCESSORS.get()) as pool:
        for start, counts in zip(starts, pool.map(reached, starts), strict=True):
            if report is not None:
                report(start - 1)
            for run, exceeding in zip(runs, counts, strict=True):
                run.counts[:] += exceeding
    return [run.result() for run in runs]


def combine_evidence(p: Float, method: str) -> Float:
    """Combine p-values (measures, ...) into z: the normal quantile of their two-sided p together.

    ``fisher`` sums minus twice their logarithms (chi squared; Fisher 1932), ``tippett`` takes the
    smallest (Tippett 1931). That p holds if they are independent; as the permuted quantity, z only
    has to rise with the evidence. It is not negative, and NaN where any p is.
    """
    limits = np.finfo(np.float64)
    count, p = len(p), np.clip(p, limits.tiny, 1 - limits.eps)
    if method == "fisher":
        joined = special.chdtrc(2 * count, -2 * np.log(p).sum(axis=0))
    else:
        joined = -np.expm1(count * np.log1p(-p.min(axis=0)))
    return np.asarray(np.abs(special.ndtri(np.clip(joined, limits.tiny, 1) / 2)), dtype=np.float64)


def _designs(part: PermutationPart, contrast: Contrast) -> tuple[Float, Float, Contrast]:
    """Return maps, the design, (points, subjects, columns) with covariates, and its contrast.

    Points at which the model cannot be fitted are missing, and have the design of another point.
    """
    if part.covariates is None:
        return part.maps, part.matrix, contrast
    prepared = glm.orthonormal(part.maps, part.matrix, [contrast], part.covariates)
    (padded,), basis, inverse, covariates = prepared
    parts = list(glm.parts_of_points(part.maps, basis, covariates))
    maps = np.hstack([values for values, _ in parts])
    designs = np.concatenate([design for _, design in parts])
    is_fitted = np.isfinite(glm.fit_block(maps, designs, GlmSettings()).sigma)
    designs[~is_fitted] = designs[is_fitted.argmax()]
    weights = Contrast(contrast.name, padded.weights @ inverse)
    return np.where(is_fitted, maps, np.nan), designs, weights


class _Member:
    """One map of a run, with the design split into what is tested and what is not."""

    def __init__(
        self,
        part: PermutationPart,
        contrast: Contrast,
        settings: MultiplicitySettings,
        blocks: Int | None,
    ) -> None:
        maps, designs, contrast = _designs(part, contrast)
        tested, nuisance = exchangeability.split(designs, contrast)
        present = np.isfinite(maps)
        residuals = np.where(present, maps, 0.0)
        if nuisance.shape[-1]:
            scores = glm.fit_block(maps, nuisance, GlmSettings()).scores
            fitted = (nuisance @ scores[:, :, None])[:, :, 0].T
            residuals = np.nan_to_num(np.where(present, maps - fitted, 0.0))
        self._subjects, self._rows = part.subjects, contrast.n_rows
        # Columns are orthonormal, tested ones first; residuals are what the others leave.
        self.basis, self._residuals = np.concatenate([tested, nuisance], axis=-1), residuals
        self._designs = None
        matrix = designs
        if part.covariates is not None:  # numbers of rows are shuffled in place of rows
            self._designs, self.basis = self.basis, np.arange(1.0, len(maps) + 1)[:, None]
            matrix, nuisance = designs[0], nuisance[0]
        self._squares = np.einsum("sp,sp->p", residuals, residuals)
        df = present.sum(axis=0) - designs.shape[-1]
        self._df = np.where((df > 0) & (self._squares > 0), df, np.nan)
        self._blocks = None if blocks is None else blocks[part.subjects]
        self._visits = part.visits and replace(part.visits, blocks=self._blocks)
        if self._visits is not None:
            exchange = exchangeability.choose_exchange(
                matrix, contrast, self._visits, settings.visits
            )
        elif exchangeability.spans(nuisance, np.ones(len(nuisance))):
            exchange = "whole"
        else:  # the columns not tested cannot make a constant: then it is tested
            exchange = "flip"
        self._exchange = exchange
        if self._blocks is not None and exchange != "flip":
            weights = matrix @ np.linalg.pinv(contrast.weights)
            varies = exchangeability.varies_inside(weights, self._blocks)
            if self._visits is not None and exchange == "whole":
                varies = exchangeability.varies_between(weights, self._visits)
            if not varies:  # shuffling cannot break it up
                raise ModelError(
                    f"permutation: {contrast.name} does not vary inside the blocks; remove "
                    "--blocks, or choose larger blocks"
                )

    def shuffled(self, keys: Float) -> Float:
        """Permuted designs (batch, columns, subjects) that are given by keys of subjects."""
        basis, part_keys = self.basis, keys[:, self._subjects]
        designs = np.empty((len(keys), *basis.T.shape))
        for design, key, part_key in zip(designs, keys, part_keys, strict=True):
            if self._visits is not None:
                shuffled = self._visits.shuffle(basis, self._exchange, key, part_key)
            elif self._exchange == "flip":
                shuffled = exchangeability.flip(basis, part_key)
            else:
                shuffled = exchangeability.shuffle(basis, self._blocks, part_key)
            design[:] = shuffled.T
        return designs

    def statistics(self, bases: Float) -> Float:
        """Signed t, or square root of F, (batch, points) of bases (batch, columns, subjects)."""
        if self._designs is None:
            # One product of large matrices is many times as fast as one for each basis.
            flat = bases.reshape(-1, bases.shape[2]) @ self._residuals
            scores = flat.reshape(*bases.shape[:2], -1)
        else:
            scores = self._scores(bases[:, 0], self._designs)
        noise = self._squares - np.einsum("bcp,bcp->bp", scores, scores)
        tested = scores[:, : self._rows]
        gained = np.einsum("bcp,bcp->bp", tested, tested) / self._rows
        # Rounding only may take the noise below zero, where the model fits perfectly.
        t = np.sqrt(gained * self._df / np.maximum(noise, np.finfo(np.float64).eps * self._squares))
        return np.asarray(np.copysign(t, tested[:, 0]) if self._rows == 1 else t, dtype=np.float64)

    def _scores(self, numbers: Float, designs: Float) -> Float:
        """Scores (batch, columns, points) of designs that differ by point.

        ``numbers`` (batch, subjects) are of shuffled rows, from 1, negative where they are flipped.
        """
        rows = np.argsort(np.abs(numbers), axis=1)
        signs = np.sign(np.take_along_axis(numbers, rows, axis=1))
        parts = arrays.blocks(len(rows), max(_VALUES // self._residuals.size, 1))
        residuals = self._residuals.T
        scores = [(residuals[:, rows[part]] * signs[part]) @ designs for part in parts]
        return np.concatenate(scores, axis=1).transpose(1, 2, 0)

    def p_values(self, t: Float) -> Float:
        """Two-sided p-values of these statistics."""
        if self._rows == 1:
            return np.asarray(2 * special.stdtr(self._df, -np.abs(t)), dtype=np.float64)
        return np.asarray(special.fdtrc(self._rows, self._df, t**2), dtype=np.float64)


class _Run:
    """One map, or several that are combined, with counts of what reached the observed statistics.

    ``counts`` (3, points) are of each point alone, of the maximum, and of the enhanced maximum.
    """

    def __init__(
        self,
        parts: Sequence[PermutationPart],
        contrast: Contrast,
        settings: MultiplicitySettings,
        blocks: Int | None,
        combine: str | None,
    ) -> None:
        self._members = [_Member(part, contrast, settings, blocks) for part in parts]
        self._combine, self._settings, self._edges = combine, settings, parts[0].edges
        self._is_squared = contrast.n_rows > 1 and combine is None
        self._observed, self._enhanced = self._statistics([m.basis.T[None] for m in self._members])
        self.counts = np.ones((3, self._observed.shape[1]))

    def _statistics(self, bases: Sequence[Float]) -> tuple[Float, Float]:
        """Statistics, and enhanced ones where the method has these, by designs of the members."""
        pairs = zip(self._members, bases, strict=True)
        if self._combine is None:
            ((member, basis),) = pairs
            t = member.statistics(basis)
        else:
            p = [member.p_values(member.statistics(basis)) for member, basis in pairs]
            t = combine_evidence(np.stack(p), self._combine)
        is_maximum = self._settings.method == _MAXIMUM
        return t, np.zeros_like(t) if is_maximum else enhance(t, self._edges)

    def shuffled(self, keys: Float) -> tuple[Float, Float]:
        """Statistics, and enhanced ones, of the permutations that are given by keys of subjects."""
        return self._statistics([member.shuffled(keys) for member in self._members])

    def reached(self, t: Float, highest: Float, highest_enhanced: Float) -> Float:
        """Count (3, points) permutations that reach the observed values."""
        pairs = ((t, self._observed), (highest, self._observed), (highest_enhanced, self._enhanced))
        # Values may be off by rounding.
        reach = [np.abs(values) >= np.abs(observed) * (1 - _ROUNDING) for values, observed in pairs]
        return np.stack([values.sum(axis=0, dtype=np.float64) for values in reach])

    def result(self) -> PermutationTest:
        """Turn counts into p-values."""
        t = self._observed[0]
        p = np.where(np.isnan(t), np.nan, self.counts / self._settings.permutations)
        if self._settings.method == _MAXIMUM:
            p[2] = np.nan
        return PermutationTest(p[0], p[1], p[2], t**2 if self._is_squared else t)


def _maximum(values: Float) -> Float:
    """Largest size on each map."""
    return np.asarray(np.nanmax(np.abs(values), axis=1, keepdims=True, initial=0.0))


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

    def at_least(self, p: Float) -> "Discoveries":
        """Raise adjusted p-values to the raw ones, as of a margin, which a single point may miss.

        Two-stage procedures reject raw p-values above ``alpha`` where most hypotheses are false.
        """
        rejected = self.rejected & (p <= self.alpha)
        cutoff = p[rejected].max() if rejected.any() else min(self.cutoff, self.alpha)
        adjusted = np.maximum(self.adjusted, p)
        return replace(self, adjusted=adjusted, rejected=rejected, cutoff=float(cutoff))


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
    groups: dict[tuple[str, ...], list[MapKey]] = {}
    for key in maps:
        family = tuple(getattr(key, name) for name in FAMILY[scope])
        groups.setdefault(family, []).append(key)
    return list(groups.values())


def discover(
    maps: Mapping[MapKey, Float], settings: MultiplicitySettings
) -> dict[MapKey, Discoveries]:
    """Control the false discovery rate of several maps (points,), in families."""
    discoveries = {}
    for keys in families(maps, settings.scope):
        p = np.concatenate([maps[key] for key in keys])
        rejections = control_fdr(p, settings.alpha, settings.method)
        ends = np.cumsum([len(maps[key]) for key in keys])[:-1]
        adjusted = np.split(rejections.adjusted, ends)
        rejected = np.split(rejections.rejected, ends)
        for key, values, flags in zip(keys, adjusted, rejected, strict=True):
            discoveries[key] = replace(rejections, adjusted=values, rejected=flags)
    return {key: discoveries[key] for key in maps}


def correct_joint(
    groups: Mapping[MapKey, Mapping[str, tuple[FittedMaps, str]]],
    contrasts: Mapping[str, Contrast],
    model: RowModel,
    table: pd.DataFrame,
    rules: MultiplicitySettings,
    *,
    combine: str,
    report: Report | None = None,
) -> dict[MapKey, tuple[PermutationTest, Discoveries]]:
    """Test maps together that have the same points: fits and measures by title, by result."""
    if rules.method not in PERMUTATIONS:
        rules = rules.changed(method=_MAXIMUM)

    def parts(key: MapKey) -> list[PermutationPart]:
        return [_part(*members, model, rules) for members in groups[key].values()]

    tested = {key: contrasts[key.contrast] for key in groups}
    blocks = row_blocks(model, table, rules)
    return _permuted(tested, parts, blocks, rules, combine=combine, report=report)


def _permuted(
    tested: Mapping[MapKey, Contrast],
    part: Callable[[MapKey], PermutationPart | list[PermutationPart]],
    blocks: Int | None,
    rules: MultiplicitySettings,
    *,
    raw: Mapping[MapKey, Float] | None = None,
    combine: str | None = None,
    report: Report | None = None,
) -> dict[MapKey, tuple[PermutationTest, Discoveries]]:
    """Permute families of maps; ``raw`` replaces the p-values of points for cut-offs."""
    results_of: dict[MapKey, tuple[PermutationTest, Discoveries]] = {}
    groups = families(tested, rules.scope)
    enhanced = rules.method == "permutation-tfce"
    for number, keys in enumerate(groups):

        def count(number_done: int, before: int = number * rules.permutations) -> None:
            if report is not None:
                report(before + number_done, len(groups) * rules.permutations)

        parts, first = [part(key) for key in keys], tested[keys[0]]
        results = permute(
            parts, first, settings=rules, blocks=blocks, report=count, combine=combine
        )
        corrected = [result.p_enhanced if enhanced else result.p_max for result in results]
        points = [result.p_uncorrected for result in results]
        if raw is not None:  # a test that ordinary p-values do not have is no test
            pairs = zip(keys, corrected, strict=True)
            corrected = [np.where(np.isfinite(raw[key]), p, np.nan) for key, p in pairs]
            points = [raw[key] for key in keys]
        rejected = [p <= rules.alpha for p in corrected]
        n_tests = sum(int(np.isfinite(p).sum()) for p in corrected)
        cutoff = np.nan
        if n_tests and not enhanced:
            p, survive = np.concatenate(points), np.concatenate(rejected)
            cutoff = p[survive].max() if survive.any() else np.nanmin(p) * BELOW_ALL
        for key, result, p, flags in zip(keys, results, corrected, rejected, strict=True):
            results_of[key] = result, Discoveries(p, flags, float(cutoff), n_tests, rules.alpha)
    return results_of


def _part(
    fitted: FittedMaps, measure: str, model: RowModel, rules: MultiplicitySettings
) -> PermutationPart:
    is_fitted = np.isfinite(fitted.fits[measure].sigma)
    values = fitted.values(measure)
    return PermutationPart(
        maps=values if is_fitted.all() else np.where(is_fitted, values, np.nan),
        matrix=model.design.matrix[fitted.rows],
        subjects=fitted.rows,
        edges=edges_of(fitted.maps, rules.neighbors),
        visits=None if model.visits is None else model.visits.take(fitted.rows),
        covariates=fitted.covariates,
    )


def correct(
    fitted: Mapping[str, FittedMaps],
    model: RowModel,
    table: pd.DataFrame,
    rules: MultiplicitySettings,
    *,
    report: Report | None = None,
) -> dict[MapKey, Discoveries]:
    """Determine the points that survive, in families."""
    tests = {
        MapKey(measure, test.contrast.name, hemi): test
        for hemi, side in fitted.items()
        for measure, fit in side.fits.items()
        for test in fit.tests
    }
    if rules.method not in PERMUTATIONS:
        discoveries = discover({key: test.p for key, test in tests.items()}, rules)
        return {
            key: discoveries[key].at_least(test.p) if test.contrast.side else discoveries[key]
            for key, test in tests.items()
        }
    permuted = _permuted(
        {key: test.contrast for key, test in tests.items()},
        lambda key: _part(fitted[key.hemi], key.measure, model, rules),
        row_blocks(model, table, rules),
        rules,
        raw={key: test.p for key, test in tests.items()},
        report=report,
    )
    return {key: permuted[key][1] for key in tests}


def check_permutations(
    rules: MultiplicitySettings,
    settings: GlmSettings,
    contrasts: Sequence[Contrast],
    *,
    further: Mapping[str, bool] = MappingProxyType({}),
) -> None:
    """Refuse permutations where rows cannot be exchanged, and of one-sided tests.

    ``further`` are flags of other tests that permute, and whether they are asked.
    """
    permuted = rules.method in PERMUTATIONS or any(further.values())
    if permuted and settings.covariance != "ordinary":
        raise ModelError("permutations assume equal variances; set glm.covariance to ordinary")
    one_sided = [contrast.name for contrast in contrasts if contrast.side]
    if permuted and one_sided:
        raise ModelError(
            f"contrast {one_sided[0]!r}: one-sided tests are not permuted; use --correction fdr2"
            + "".join(f", without {flag}" for flag in further)
        )


def row_blocks(model: RowModel, table: pd.DataFrame, rules: MultiplicitySettings) -> Int | None:
    """Return the number of each row's block, or None without blocks."""
    if not rules.blocks:
        return None
    check_names([rules.blocks], table.columns)
    labels = table[rules.blocks].iloc[model.design.rows]
    if labels.isna().any():
        raise ModelError(
            f"permutations: column {rules.blocks!r} of --blocks is missing for"
            f" {listed(labels.index[labels.isna()])}"
        )
    blocks = np.unique(labels.astype(str), return_inverse=True)[1]
    people = None if model.visits is None else model.visits.people
    if people is not None and len(np.unique([people, blocks], axis=1).T) > len(np.unique(people)):
        raise ModelError(
            f"permutations: {rules.blocks!r} of --blocks changes between visits of a participant;"
            " choose a column that does not"
        )
    return np.asarray(blocks, dtype=np.int64)
