"""Family-wise error rates by permutation of residuals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from hipsta_bids.errors import ModelError
from hipsta_bids.group.adjacency import enhance, enhance_on_mesh
from hipsta_bids.group.formula import Contrast
from hipsta_bids.group.glm import fit_points
from hipsta_bids.group.settings import GlmSettings, MultiplicitySettings

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Permutations whose maps are in memory at once; does not change a result.
_BATCH = 50
#: Sums in another order differ by less, relatively.
_ROUNDING = 1e-9
#: The method that does without cluster enhancement.
_MAXIMUM = "permutation-max"
#: Length left of the constant vector, of length 1, if it is not among the columns.
_CONSTANT = 1e-6


@dataclass(frozen=True)
class PermutationTest:
    """Corrected p-values; the family is all points of all parts."""

    p_max: FloatArray
    """(points,) of the statistic itself (maximum over the sheet)."""
    p_enhanced: FloatArray
    """(points,) of the cluster-enhanced statistic; NaN with ``permutation-max``."""
    p_uncorrected: FloatArray
    """(points,) of each point alone."""
    statistic: FloatArray
    """(points,) t, or F."""
    enhanced: FloatArray
    """(points,) threshold-free cluster enhancement of t, or of the square root of F."""


@dataclass(frozen=True, eq=False)
class PermutationPart:
    """Maps of one sheet, as of one hemisphere."""

    maps: FloatArray
    """(subjects, points) in the order of the sheet, ``x`` slower than ``y``; NaN is missing."""
    matrix: FloatArray
    """(subjects, columns) design of full column rank."""
    subjects: IntArray
    """(subjects,) which ones of the whole sample they are: the same subject is shuffled in the
    same way in all parts."""
    edges: IntArray | None = None
    """(edges, 2) neighbors among the points, if these are vertices of a mesh."""


def permute(
    parts: Sequence[PermutationPart],
    contrast: Contrast,
    shape: tuple[int, int],
    *,
    settings: MultiplicitySettings,
    blocks: IntArray | None = None,
) -> list[PermutationTest]:
    """Permutation test of one contrast at all points (Freedman and Lane 1983).

    What the covariates explain is taken off, the residuals are shuffled between subjects, and
    the whole model is fitted to them again (Winkler et al. 2014). If the contrast tests what
    all subjects have in common (an intercept), signs are flipped instead of subjects shuffled.

    Missing values count as what the covariates predict, which shrinks an effect; degrees of
    freedom are those of the subjects present.
    """
    runs = [_Part.build(part, contrast, shape, settings, blocks) for part in parts]
    random = np.random.default_rng(settings.seed)
    n_subjects = 1 + max(int(part.subjects.max()) for part in parts)
    for start in range(1, settings.permutations, _BATCH):
        count = min(_BATCH, settings.permutations - start)
        keys = random.random((count, n_subjects))
        maps = [run.shuffled(keys) for run in runs]
        highest = np.max([_maximum(t) for t, _ in maps], axis=0)
        highest_enhanced = np.max([_maximum(raised) for _, raised in maps], axis=0)
        for run, (t, _) in zip(runs, maps, strict=True):
            run.count(t, highest, highest_enhanced)
    return [run.result(settings) for run in runs]


@dataclass(frozen=True, eq=False)
class _Part:
    """One part under way, with its counts of what reached the observed statistics."""

    model: "_Model"
    contrast: Contrast
    shape: tuple[int, int]
    edges: IntArray | None
    settings: MultiplicitySettings
    subjects: IntArray
    blocks: IntArray | None
    observed: FloatArray
    height: FloatArray
    counts: FloatArray
    """(3, points) of each point alone, of the maximum, and of the enhanced maximum."""

    @classmethod
    def build(
        cls,
        part: PermutationPart,
        contrast: Contrast,
        shape: tuple[int, int],
        settings: MultiplicitySettings,
        blocks: IntArray | None,
    ) -> "_Part":
        maps, matrix = part.maps, part.matrix
        shape = shape if part.edges is None else (maps.shape[1], 1)
        if maps.shape[1] != shape[0] * shape[1] or maps.shape[0] != matrix.shape[0]:
            raise ModelError(
                f"permutation: maps of shape {maps.shape} do not fit a sheet of {shape[0]} x"
                f" {shape[1]} points and {matrix.shape[0]} subjects",
                reason="design-shape",
            )
        model = _Model.build(maps, matrix, contrast)
        own = None if blocks is None else blocks[part.subjects]
        if own is not None and not model.tests_common_part():
            _check_blocks(matrix @ np.linalg.pinv(contrast.weights), own, contrast)
        observed = model.statistics(model.basis[None])
        return cls(
            model=model,
            contrast=contrast,
            shape=shape,
            edges=part.edges,
            settings=settings,
            subjects=part.subjects,
            blocks=own,
            observed=observed,
            height=_enhanced(observed, shape, part.edges, settings),
            counts=np.ones((3, maps.shape[1])),
        )

    def shuffled(self, keys: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Statistics, and enhanced ones, of permutations that keys of all subjects say."""
        flip = self.model.tests_common_part()
        bases = [
            _shuffle(self.model.basis, self.blocks, key[self.subjects], flip=flip) for key in keys
        ]
        t = self.model.statistics(np.stack(bases))
        return t, _enhanced(t, self.shape, self.edges, self.settings)

    def count(self, t: FloatArray, highest: FloatArray, highest_enhanced: FloatArray) -> None:
        """Count what reaches the observed statistics, alone and anywhere in the family."""
        self.counts[0] += _at_least(t, self.observed).sum(axis=0)
        self.counts[1] += _at_least(highest, self.observed).sum(axis=0)
        self.counts[2] += _at_least(highest_enhanced, self.height).sum(axis=0)

    def result(self, settings: MultiplicitySettings) -> PermutationTest:
        """Turn counts into p-values."""
        missing = np.isnan(self.observed[0])
        p = np.where(missing, np.nan, self.counts / settings.permutations)
        enhanced = np.where(missing, np.nan, self.height[0])
        if settings.method == _MAXIMUM:
            p[2], enhanced = np.nan, np.full(len(missing), np.nan)
        single = self.contrast.n_rows == 1
        return PermutationTest(
            p_uncorrected=p[0],
            p_max=p[1],
            p_enhanced=p[2],
            statistic=self.observed[0] if single else self.observed[0] ** 2,
            enhanced=enhanced,
        )


def _check_blocks(tested: FloatArray, blocks: IntArray, contrast: Contrast) -> None:
    """Refuse blocks inside which what is tested does not vary: shuffling would not undo it."""
    numbers = np.unique(blocks, return_inverse=True)[1]
    sizes = np.bincount(numbers)
    means = np.stack([np.bincount(numbers, column) for column in tested.T], axis=1) / sizes[:, None]
    if np.abs(tested - means[numbers]).max() < _CONSTANT * np.abs(tested).max():
        raise ModelError(
            f"permutation: {contrast.name} does not vary inside the blocks, so that shuffling there"
            " says nothing about it; leave --blocks out, or choose larger blocks",
            reason="permutation-blocks",
        )


def _enhanced(
    t: FloatArray, shape: tuple[int, int], edges: IntArray | None, settings: MultiplicitySettings
) -> FloatArray:
    """Cluster enhancement, where it is asked for; else nothing."""
    if settings.method == _MAXIMUM:
        return np.zeros_like(t)
    if edges is not None:
        return enhance_on_mesh(t, edges, settings)
    return enhance(t.reshape(len(t), *shape), settings).reshape(t.shape)


@dataclass(frozen=True)
class _Model:
    """The design, split into what is tested and what is not; both orthonormal."""

    basis: FloatArray
    """(subjects, columns), tested ones first."""
    rows: int
    residuals: FloatArray
    """(subjects, points) what the columns not tested leave; zero where missing."""
    squares: FloatArray
    df: FloatArray
    """(points,) NaN where there is nothing to test."""

    @classmethod
    def build(cls, maps: FloatArray, matrix: FloatArray, contrast: Contrast) -> "_Model":
        rows = contrast.n_rows
        # Orthogonal to the rest; its product with the data is the estimated contrast.
        tested = matrix @ np.linalg.solve(matrix.T @ matrix, contrast.weights.T)
        tested = tested / np.linalg.norm(tested) if rows == 1 else np.linalg.qr(tested)[0]
        rest = np.linalg.qr(matrix @ null_space(contrast.weights))[0]
        present = np.isfinite(maps)
        residuals = np.where(present, maps, 0.0)
        if rest.shape[1]:
            fitted = rest @ fit_points(maps, rest, (), GlmSettings()).coefficients
            residuals = np.nan_to_num(np.where(present, maps - fitted, 0.0))
        squares = np.einsum("sp,sp->p", residuals, residuals)
        df = present.sum(axis=0) - matrix.shape[1]
        usable = (df > 0) & (squares > 0)
        basis = np.column_stack([tested, rest])
        return cls(basis, rows, residuals, squares, np.where(usable, df, np.nan))

    def tests_common_part(self) -> bool:
        """Whether the columns not tested cannot make a constant: then it is tested."""
        ones = np.full(len(self.basis), 1 / np.sqrt(len(self.basis)))
        rest = self.basis[:, self.rows :]
        return bool(np.linalg.norm(ones - rest @ (rest.T @ ones)) > _CONSTANT)

    def statistics(self, bases: FloatArray) -> FloatArray:
        """Signed t, or square root of F, of (batch, points)."""
        scores = np.swapaxes(bases, 1, 2) @ self.residuals
        noise = self.squares - np.einsum("bcp,bcp->bp", scores, scores)
        tested = scores[:, : self.rows]
        gained = np.einsum("bcp,bcp->bp", tested, tested) / self.rows
        # Rounding only may take the noise below zero, where the model fits perfectly.
        t = np.sqrt(gained * self.df / np.maximum(noise, np.finfo(np.float64).eps * self.squares))
        return np.asarray(np.copysign(t, tested[:, 0]) if self.rows == 1 else t, dtype=np.float64)


def _shuffle(
    basis: FloatArray, blocks: IntArray | None, key: FloatArray, *, flip: bool
) -> FloatArray:
    """Shuffle subjects, within blocks; the same as shuffling residuals the other way round.

    Keys are uniform between 0 and 1: their order is the permutation, their halves are signs.
    """
    if flip:
        signs: FloatArray = np.where(key < 0.5, -1.0, 1.0)[:, None]  # noqa: PLR2004 -- half of them
        return basis * signs
    if blocks is None:
        return basis[np.argsort(key)]
    result = basis.copy()
    result[np.argsort(blocks, kind="stable")] = basis[np.lexsort((key, blocks))]
    return result


def _maximum(values: FloatArray) -> FloatArray:
    """Largest size on each map."""
    return np.asarray(np.nanmax(np.abs(values), axis=1, keepdims=True, initial=0.0))


def _at_least(values: FloatArray, observed: FloatArray) -> NDArray[np.bool_]:
    """Whether values reach those observed, but for rounding."""
    return np.abs(values) >= np.abs(observed) * (1 - _ROUNDING)
