"""Family-wise error rates by permutation of residuals."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from hipsta_bids.errors import ModelError
from hipsta_bids.group.contrasts import Contrast
from hipsta_bids.group.glm import fit_points
from hipsta_bids.group.sheet_graph import enhance
from hipsta_bids.group_settings import GlmSettings, MultiplicitySettings

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Permutations whose maps are in memory at once; does not change a result.
_BATCH = 50
#: Sums in another order differ by less, relatively.
_ROUNDING = 1e-9
#: Length left of the constant vector, of length 1, if it is not among the columns.
_CONSTANT = 1e-6


@dataclass(frozen=True)
class PermutationTest:
    """Corrected p-values; the family is all points given."""

    p_max: FloatArray
    """(points,) of the statistic itself (maximum over the sheet)."""
    p_enhanced: FloatArray
    """(points,) of the cluster-enhanced statistic."""
    p_uncorrected: FloatArray
    """(points,) of each point alone."""
    statistic: FloatArray
    """(points,) t, or F."""
    enhanced: FloatArray
    """(points,) threshold-free cluster enhancement of t, or of the square root of F."""


def permute(
    maps: FloatArray,
    matrix: FloatArray,
    contrast: Contrast,
    shape: tuple[int, int],
    *,
    settings: MultiplicitySettings,
    blocks: IntArray | None = None,
) -> PermutationTest:
    """Permutation test of one contrast at all points (Freedman and Lane 1983).

    What the covariates explain is taken off, the residuals are shuffled between subjects, and
    the whole model is fitted to them again (Winkler et al. 2014). If the contrast tests what
    all subjects have in common (an intercept), signs are flipped instead of subjects shuffled.

    Missing values count as what the covariates predict, which shrinks an effect; degrees of
    freedom are those of the subjects present.

    Parameters
    ----------
    maps : ndarray, shape (subjects, points)
        Points in the order of the sheet, ``x`` slower than ``y``.
    matrix : ndarray, shape (subjects, columns)
        Design of full column rank.
    contrast : Contrast
        One row is tested two-sidedly.
    shape : (int, int)
        Nodes of the sheet along x and y.
    settings : MultiplicitySettings
        Number and seed of permutations, and cluster enhancement.
    blocks : ndarray of int, shape (subjects,), optional
        Subjects are shuffled within a block only (as sites, or sessions of a subject).

    Returns
    -------
    PermutationTest

    Raises
    ------
    ModelError
        If the sheet does not have the maps' number of points.
    """
    if maps.shape[1] != shape[0] * shape[1] or maps.shape[0] != matrix.shape[0]:
        raise ModelError(
            f"permutation: maps of shape {maps.shape} do not fit a sheet of {shape[0]} x"
            f" {shape[1]} points and {matrix.shape[0]} subjects",
            reason="design-shape",
        )
    model = _Model.build(maps, matrix, contrast)
    random = np.random.default_rng(settings.seed)
    observed = model.statistics(model.basis[None])
    signs_only = model.tests_common_part()
    height = enhance(observed.reshape(1, *shape), settings).reshape(1, -1)
    own, highest, enhanced = (np.ones(maps.shape[1]) for _ in range(3))
    for start in range(1, settings.permutations, _BATCH):
        count = min(_BATCH, settings.permutations - start)
        shuffled = [_shuffle(model.basis, blocks, random, flip=signs_only) for _ in range(count)]
        t = model.statistics(np.stack(shuffled))
        raised = enhance(t.reshape(count, *shape), settings).reshape(count, -1)
        own += _at_least(t, observed).sum(axis=0)
        highest += _at_least(_maximum(t), observed).sum(axis=0)
        enhanced += _at_least(_maximum(raised), height).sum(axis=0)
    missing = np.isnan(observed[0])
    p = np.where(missing, np.nan, np.stack([own, highest, enhanced]) / settings.permutations)
    return PermutationTest(
        p_uncorrected=p[0],
        p_max=p[1],
        p_enhanced=p[2],
        statistic=observed[0] if contrast.n_rows == 1 else observed[0] ** 2,
        enhanced=np.where(missing, np.nan, height[0]),
    )


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
    basis: FloatArray, blocks: IntArray | None, random: np.random.Generator, *, flip: bool
) -> FloatArray:
    """Shuffle subjects, within blocks; the same as shuffling residuals the other way round."""
    if flip:
        signs: FloatArray = random.choice([-1.0, 1.0], size=(len(basis), 1))
        return basis * signs
    key = random.random(len(basis))
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
