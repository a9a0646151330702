"""The general linear model at every point of a map, and for single measures."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.linalg import block_diag
from statsmodels.regression.linear_model import OLS

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import arrays
from hipsta_bids.stats.arrays import Bool, Float, Int, SideMaps
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.design import Design
from hipsta_bids.stats.exchangeability import Visits
from hipsta_bids.stats.limits import f_limits, t_limits
from hipsta_bids.stats.settings import GlmSettings

#: Points are left out where the missing values take away all but this fraction of what the data
#: say about a direction of the coefficients.
MIN_INFORMATION = 1e-8

#: Contrast of what all rows have in common.
MEAN = "mean"
#: Values in memory at once; bounds the temporaries, and does not change a result.
_CHUNK = 4_000_000


@dataclass(frozen=True)
class PointTest:
    """One contrast at each point; NaN where the model could not be fitted."""

    contrast: Contrast
    statistic: Float
    """(points,) t, or F for contrasts of several rows; t of the difference from a margin."""
    p: Float
    """(points,) two-sided, unless the contrast has a side."""
    df: Float
    """(points,) residual degrees of freedom."""
    estimate: Float
    """(rows, points) in units of the map."""
    se: Float
    """(rows, points) standard errors."""
    cohen_d: Float
    """(points,) estimate over residual standard deviation; NaN for several rows."""
    cohen_d_limits: Float
    """(2, points)"""
    eta_squared: Float
    """(points,) partial: share of the variance that the covariates leave."""
    eta_squared_limits: Float
    """(2, points)"""
    further: Mapping[str, Float] = field(default_factory=dict)
    """(points,) effect sizes of extensions, by column of tables."""

    @property
    def kind(self) -> str:
        """``t`` or ``F``."""
        return "t" if self.contrast.n_rows == 1 else "F"

    @property
    def effect(self) -> Float:
        """(points,) Cohen's d, or of F partial eta squared."""
        return self.cohen_d if self.kind == "t" else self.eta_squared


@dataclass(frozen=True)
class PointwiseFit:
    """A linear or mixed model at each point."""

    coefficients: Float
    """(columns, points) in units of the map per unit of the column."""
    sigma: Float
    """(points,) residual standard deviation; of repeated visits that of single visits."""
    n: Int
    """(points,) rows with a value."""
    tests: tuple[PointTest, ...]
    """In the order of the contrasts."""
    variances: Mapping[str, Float] = field(default_factory=dict)
    """(points,) components of a mixed model: ``residual`` within participants or sites,
    ``participant`` between them (with random slopes, at the mean time), and ``slope`` per squared
    unit of time."""
    slopes_p: Float | None = None
    """(points,) p-value of random slopes, where they are fitted."""


@dataclass(frozen=True)
class PointBlock:
    """The fit at some points, in coordinates in which the complete design is orthonormal."""

    scores: Float
    """(points, columns)"""
    covariance: Float
    """(points, columns, columns)"""
    sigma: Float
    """(points,) NaN where the model cannot be fitted."""
    n: Int
    """(points,) subjects with a value."""


def fit_points(
    maps: Float,
    matrix: Float,
    contrasts: Sequence[Contrast],
    settings: GlmSettings,
    covariates: Float | None = None,
) -> PointwiseFit:
    """Fit the same linear model to each column of a table, with values missing anywhere.

    ``covariates`` (maps, rows, points) have a value at each point, and are further columns of the
    design there, as differences from their mean at the point (Casanova et al. 2007,
    doi:10.1016/j.neuroimage.2006.09.011). Contrasts have weights of ``covariates`` after the
    weights of the matrix, or none.
    """
    contrasts, basis, inverse, covariates = orthonormal(maps, matrix, contrasts, covariates)
    columns = len(inverse)
    fits = [fit_block(*part, settings) for part in parts_of_points(maps, basis, covariates)]
    names = ("scores", "covariance", "sigma", "n")
    fit = PointBlock(*(np.concatenate([getattr(fit, name) for fit in fits]) for name in names))
    df = np.where(np.isfinite(fit.sigma), fit.n - columns, np.nan)
    tests = tuple(_test(c, c.weights @ inverse, fit, df, settings.confidence) for c in contrasts)
    return PointwiseFit(inverse @ fit.scores.T, fit.sigma, fit.n, tests)


def orthonormal(
    maps: Float, matrix: Float, contrasts: Sequence[Contrast], covariates: Float | None = None
) -> tuple[Sequence[Contrast], Float, Float, Float | None]:
    """Check a design, and make its columns orthonormal and its covariates of like size.

    Returns contrasts with a weight per column, the columns, the matrix from their
    coefficients to coefficients of the design, and the covariates.
    """
    if covariates is None:
        check_design(maps, matrix, contrasts)
        basis, triangle = np.linalg.qr(matrix)
        return contrasts, basis, np.linalg.inv(triangle), None
    columns = matrix.shape[1] + len(covariates)
    widths = [(0, 0), (0, len(covariates))]
    contrasts = [
        contrast
        if contrast.weights.shape[1] != matrix.shape[1]
        else replace(contrast, weights=np.pad(contrast.weights, widths))
        for contrast in contrasts
    ]
    check_design(maps, matrix, contrasts, columns)
    basis, triangle = np.linalg.qr(matrix)
    scales = np.nanstd(covariates, axis=1).mean(axis=1, where=np.isfinite(maps).any(axis=0))
    scales = np.maximum(scales, np.finfo(np.float64).tiny) * np.sqrt(len(maps))
    inverse = block_diag(np.linalg.inv(triangle), np.diag(1 / scales))
    return contrasts, basis, inverse, covariates / scales[:, None, None]


def parts_of_points(
    maps: Float, basis: Float, covariates: Float | None
) -> Iterator[tuple[Float, Float]]:
    """Return maps and designs of some points at a time.

    With covariates, designs are (points, rows, columns): covariates are centered at each point, and
    rows without them have no value.
    """
    count = 0 if covariates is None else len(covariates)
    for part in chunks(maps.shape, basis.shape[1] + count):
        values = np.asarray(maps[:, part], dtype=np.float64)
        if covariates is None:
            yield values, basis
            continue
        added = covariates[:, :, part]
        values = np.where(np.isfinite(added).all(axis=0), values, np.nan)
        added = np.where(np.isfinite(values), added, np.nan)
        centered = np.nan_to_num(added - arrays.mean_of_known(added, 1)[:, None])
        fixed = np.broadcast_to(basis, (values.shape[1], *basis.shape))
        yield values, np.concatenate([fixed, centered.transpose(2, 1, 0)], axis=2)


def check_design(
    maps: Float, matrix: Float, contrasts: Sequence[Contrast], columns: int | None = None
) -> None:
    """Refuse a design that cannot be fitted, as where some rows have no maps."""
    columns = matrix.shape[1] if columns is None else columns
    if maps.ndim != 2 or matrix.ndim != 2 or maps.shape[0] != matrix.shape[0]:  # noqa: PLR2004 -- tables
        raise ModelError(
            f"model: maps of shape {maps.shape} do not fit a design of shape {matrix.shape};"
            " both need as many rows"
        )
    if not np.isfinite(matrix).all():
        raise ModelError("model: the design has missing values; keep complete rows only")
    if np.linalg.matrix_rank(matrix) < matrix.shape[1]:
        raise ModelError(
            f"model: the design's {matrix.shape[1]} columns are not independent, given "
            f"{matrix.shape[0]} rows; remove one"
        )
    for contrast in contrasts:
        if contrast.weights.shape[1] != columns:
            raise ModelError(
                f"contrast {contrast.name!r} has {contrast.weights.shape[1]} weights, the design"
                f" {columns} columns"
            )


def products_of(matrix: Float) -> Float:
    """(rows, columns * columns) products of the values of each row."""
    return (matrix[:, :, None] * matrix[:, None, :]).reshape(len(matrix), -1)


def information(present: Bool, basis: Float) -> Float:
    """Sum the products of columns over the rows with a value, (points, columns, columns)."""
    if basis.ndim == 2:  # noqa: PLR2004 -- one design for all points
        sums = present.T.astype(np.float64) @ products_of(basis)
        return np.asarray(sums.reshape(-1, *basis.shape[1:] * 2))
    return np.asarray(np.swapaxes(basis, 1, 2) @ (basis * present.T[:, :, None]))


def by_row(basis: Float) -> Float:
    """(rows, points or 1, columns) of a design, or of one for each point."""
    return basis[:, None] if basis.ndim == 2 else basis.swapaxes(0, 1)  # noqa: PLR2004


def sum_by(numbers: Int, values: Float) -> Float:
    """Sum rows of values (rows, ...) by numbers from 0 on, each of which occurs."""
    order = np.argsort(numbers, kind="stable")
    starts = np.searchsorted(numbers[order], np.arange(numbers.max() + 1))
    return np.asarray(np.add.reduceat(values[order], starts, axis=0))


def chunks(shape: tuple[int, ...], columns: int, n_values: int = 0) -> Iterator[slice]:
    """Split points into ranges with at most some values, such as fit into memory together."""
    step = max(1, (n_values or _CHUNK) // (shape[0] * columns))
    return (slice(start, start + step) for start in range(0, max(shape[1], 1), step))


def fit_block(maps: Float, basis: Float, settings: GlmSettings) -> PointBlock:
    """Solve least squares at some points, by normal equations in orthonormal coordinates.

    There the equations of a complete point are the identity, and the equations of other points stay
    well conditioned unless the missing subjects really carried a column. ``basis`` is (rows,
    columns), or (points, rows, columns) where designs differ.
    """
    present = np.isfinite(maps)
    values, has_value = np.where(present, maps, 0.0).T[:, :, None], present.T[:, :, None]
    n, columns = present.sum(axis=0), basis.shape[-1]
    equations = information(present, basis)
    usable = np.linalg.eigvalsh(equations)[:, 0] > MIN_INFORMATION
    usable &= n - columns >= settings.min_residual_df
    safe = np.where(usable[:, None, None], equations, np.eye(columns))
    inverse = np.asarray(np.linalg.inv(safe), dtype=np.float64)
    scores = inverse @ (np.swapaxes(basis, -1, -2) @ values)
    residuals = np.where(has_value, values - basis @ scores, 0.0)
    squares, total = np.sum(residuals**2, axis=(1, 2)), np.sum(values**2, axis=(1, 2))
    usable &= squares > total * np.finfo(np.float64).eps  # else the model leaves rounding only
    sigma = np.where(usable, np.sqrt(squares / np.where(usable, n - columns, 1)), np.nan)
    covariance = inverse * (sigma**2)[:, None, None]
    if settings.covariance == "hc3":
        # Residuals over (1 - leverage) (MacKinnon and White 1985); NaN where one subject alone
        # determines a coefficient.
        left = 1 - np.sum((basis @ inverse) * basis, axis=2, keepdims=True)
        is_saturated = (left < np.sqrt(np.finfo(np.float64).eps)) & has_value
        weighted = basis * (residuals / np.where(is_saturated, np.nan, left))
        covariance = inverse @ (np.swapaxes(weighted, 1, 2) @ weighted) @ inverse
    return PointBlock(
        scores=np.where(usable[:, None], scores[:, :, 0], np.nan),
        covariance=np.where(usable[:, None, None], covariance, np.nan),
        sigma=sigma,
        n=n,
    )


def _test(
    contrast: Contrast, rotated: Float, fit: PointBlock, df: Float, confidence: float
) -> PointTest:
    """Wald test of a contrast at each point."""
    estimate = fit.scores @ rotated.T
    spread = rotated @ fit.covariance @ rotated.T
    se = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    statistic = estimate[:, 0] / se[:, 0] if contrast.n_rows == 1 else _wald(estimate, spread)
    values_of = {"df": df, "estimate": estimate.T, "se": se.T, "sigma": fit.sigma}
    return with_effects(contrast, statistic, **values_of, confidence=confidence)


def with_effects(
    contrast: Contrast,
    statistic: Float,
    *,
    df: Float,
    estimate: Float,
    se: Float,
    sigma: Float,
    confidence: float,
    p: Float | None = None,
) -> PointTest:
    """Add p-values, Cohen's d (of t) and partial eta squared, with limits, to t or F."""
    rows = contrast.n_rows
    if rows == 1:
        tail = 2 * special.stdtr(df, -np.abs(statistic))
        squared = statistic**2
        cohen_d = estimate[0] / sigma
        d_limits = np.stack(t_limits(statistic, df, confidence)) * (se[0] / sigma)
        if contrast.side:
            statistic = (estimate[0] - contrast.margin) / se[0]
            p = special.stdtr(df, -statistic if contrast.side == "greater" else statistic)
    else:
        tail = special.fdtrc(float(rows), df, statistic)
        squared = statistic
        cohen_d = np.full(len(df), np.nan)
        d_limits = np.full((2, len(df)), np.nan)
    eta_limits = np.stack(f_limits(squared, rows, df, confidence))
    return PointTest(
        contrast=contrast,
        statistic=statistic,
        p=np.asarray(tail if p is None else p, dtype=np.float64),
        df=df,
        estimate=estimate,
        se=se,
        cohen_d=cohen_d,
        cohen_d_limits=d_limits,
        eta_squared=squared * rows / (squared * rows + df),
        eta_squared_limits=eta_limits / (eta_limits + df),
    )


def _wald(estimate: Float, spread: Float) -> Float:
    """F statistic of several combinations at once, at each point."""
    rows = estimate.shape[1]
    valid = np.asarray(np.isfinite(spread).all(axis=(1, 2)))
    safe = np.where(valid[:, None, None], spread, np.eye(rows))
    solved = np.linalg.solve(safe, estimate[:, :, None])[:, :, 0]
    return np.where(valid, np.sum(estimate * solved, axis=1) / rows, np.nan)


def fit_measures(
    values: Float, matrix: Float, contrasts: Sequence[Contrast], settings: GlmSettings
) -> PointwiseFit:
    """Fit the model of :func:`fit_points` by statsmodels, one column of values after the other.

    A column is excluded by the same rules, and effect sizes are the same.
    """
    check_design(values, matrix, contrasts)
    block = fit_block(values, np.linalg.qr(matrix)[0], settings)
    tested: Bool = np.asarray(np.isfinite(block.covariance).all(axis=(1, 2)))
    n_points = values.shape[1]
    coefficients = np.full((matrix.shape[1], n_points), np.nan)
    sigma, df = np.full((2, n_points), np.nan)
    # Per contrast: statistic, p, estimates of the rows, and their standard errors.
    tables = [np.full((2 + 2 * contrast.n_rows, n_points), np.nan) for contrast in contrasts]
    kind = "HC3" if settings.covariance == "hc3" else "nonrobust"
    for i in np.flatnonzero(np.isfinite(block.sigma)):
        present = np.isfinite(values[:, i])
        result = OLS(values[present, i], matrix[present]).fit(cov_type=kind, use_t=True)
        coefficients[:, i], sigma[i], df[i] = result.params, np.sqrt(result.scale), result.df_resid
        for table, contrast in zip(tables, contrasts, strict=True):
            rows = result.t_test(contrast.weights)
            whole = rows if contrast.n_rows == 1 else result.f_test(contrast.weights)
            values_of = (whole.statistic, whole.pvalue, rows.effect, rows.sd)
            table[:, i] = np.concatenate([np.ravel(values) for values in values_of])
            if not tested[i]:
                table[[0, 1, *range(2 + contrast.n_rows, len(table))], i] = np.nan
    tests = tuple(
        with_effects(
            contrast,
            table[0],
            p=table[1],
            df=df,
            estimate=table[2 : 2 + contrast.n_rows],
            se=table[2 + contrast.n_rows :],
            sigma=sigma,
            confidence=settings.confidence,
        )
        for contrast, table in zip(contrasts, tables, strict=True)
    )
    return PointwiseFit(coefficients, sigma, block.n, tests)


@dataclass(frozen=True, eq=False)
class RowModel:
    """A linear model of independent rows of a design."""

    kind: ClassVar[str] = "linear model"
    """For texts."""
    design: Design
    settings: GlmSettings

    @property
    def visits(self) -> Visits | None:
        """Whose each row is, where participants have several."""
        return None

    def people(self, rows: Int) -> Int:
        """Return the number of the participant of each row."""
        return rows

    def fit(
        self,
        values: Float,
        rows: Int,
        contrasts: tuple[Contrast, ...],
        covariates: Float | None = None,
    ) -> PointwiseFit:
        """Fit some rows of the design at each point, perhaps with maps as covariates."""
        return fit_points(values, self.design.matrix[rows], contrasts, self.settings, covariates)

    def fit_measures(
        self, values: Float, rows: Int, contrasts: tuple[Contrast, ...]
    ) -> PointwiseFit:
        """Fit some rows of the design to each summary measure."""
        return fit_measures(values, self.design.matrix[rows], contrasts, self.settings)


def with_mean(design: Design) -> tuple[Contrast, ...]:
    """Contrasts of a design, with the model's mean over all rows in front."""
    mean = Contrast(MEAN, design.matrix.mean(axis=0))
    matching = [
        c
        for c in design.contrasts
        if c.name == MEAN
        or (c.weights.shape == mean.weights.shape and np.allclose(c.weights, mean.weights))
    ]
    return design.contrasts if matching else (mean, *design.contrasts)


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedMaps:
    """Maps, and their fit."""

    maps: SideMaps
    """Of all rows of the model's table that have them."""
    used: Int
    """Sheets that the model is fitted to, as places in ``maps``."""
    rows: Int
    """Rows of the design of the sheets used."""
    subfield: Int
    """(x, y) most frequent subfield, position in ``maps.names``; -1 where there is none."""
    fits: Mapping[str, PointwiseFit]
    """By measure."""

    @property
    def covariates(self) -> Float | None:
        """(maps, sheets, points) of the sheets used that are covariates; ``None`` without."""
        return _covariates(self.maps, self.used)

    def values(self, measure: str) -> Float:
        """(sheets, points) of one measure, of all sheets used."""
        if len(self.used) == len(self.maps.rows):
            return _values(self.maps.maps[measure], self.used)
        return arrays.sheets_of(self.maps.maps, measure, self.used).reshape(len(self.used), -1)

    def parts(self, measure: str, keep: Bool) -> Iterator[Float]:
        """(sheets, points) of one measure, of some of the sheets used, a part at a time."""
        for part in arrays.parts_of_sheets(self.maps.maps, measure, self.used[keep]):
            yield part.reshape(len(part), -1)


def fit_maps(
    hemi: str, side: SideMaps, model: RowModel, *, contrasts: tuple[Contrast, ...] | None = None
) -> FittedMaps:
    """Fit a model at each point of all maps of a hemisphere."""
    _, positions, rows = np.intersect1d(
        side.rows, model.design.rows, assume_unique=True, return_indices=True
    )
    tested = model.design.contrasts if contrasts is None else contrasts
    covariates = _covariates(side, positions)
    fits = {}
    try:
        for name in side.maps:
            # Maps of a large cohort are made here: without a name, one is gone before the next.
            values = _values(side.maps[name], positions)
            if side.first is not None:
                covariates = _values(side.first.maps[name], positions)[None]
            counts = np.isfinite(values).sum(axis=0)
            values = without_small_levels(values, model, rows)
            fits[name] = replace(model.fit(values, rows, tested, covariates), n=counts)
            del values
    except ModelError as error:
        raise ModelError(f"hemisphere {hemi}: {error}") from error
    for name, fit in fits.items():
        if not np.isfinite(fit.sigma).any():
            raise ModelError(
                f"hemisphere {hemi}: no point of the {name} maps has enough values; look at "
                "the sheets, or reduce the model"
            )
        if fit.tests and not any(np.isfinite(test.se).any() for test in fit.tests):
            raise ModelError(
                f"hemisphere {hemi}: a coefficient depends on one participant at all points "
                f"of {name}; reduce the model, or unset glm.covariance"
            )
    return FittedMaps(
        maps=side,
        used=np.asarray(positions, dtype=np.int64),
        rows=np.asarray(rows, dtype=np.int64),
        subfield=most_frequent(side.subfield[positions], len(side.names)),
        fits=fits,
    )


def without_small_levels(values: Float, model: RowModel, rows: Int) -> Float:
    """Set points to missing at which a level of a factor has too few participants with a value.

    ``values`` (rows, points); complete maps are returned as they are.
    """
    members, least = model.design.members, model.design.min_level
    known = np.isfinite(values)
    if members is None or not len(members) or known.all():
        return values
    people = model.people(rows)
    order = np.argsort(people, kind="stable")
    starts = np.flatnonzero(np.diff(people[order], prepend=-1))
    is_small = np.zeros(known.shape[1], dtype=bool)
    for member in members[rows[order]].T:
        has_value = np.logical_or.reduceat(known[order] & member[:, None], starts, axis=0)
        is_small |= has_value.sum(axis=0) < least
    # Of large cohorts, a copy takes much memory: none is made where no value would change.
    return np.where(is_small, np.nan, values) if known[:, is_small].any() else values


def _covariates(side: SideMaps, positions: Int) -> Float | None:
    maps = [_values(values, positions) for values in side.covariates.values()]
    return np.stack(maps).astype(np.float64) if maps else None


def _values(maps: Float, positions: Int) -> Float:
    selected = maps if len(positions) == len(maps) else maps[positions]
    return selected.reshape(len(positions), -1)


def most_frequent(labels: NDArray[np.int8], count: int) -> Int:
    """Most frequent label at each point."""
    if not count:
        return np.full(labels.shape[1:], -1, dtype=np.int64)
    votes = np.stack([(labels == label).sum(axis=0) for label in range(count)])
    return np.where(votes.max(axis=0) > 0, votes.argmax(axis=0), -1).astype(np.int64)


def points_of(side: SideMaps) -> FittedMaps:
    """Locate the points of maps of one hemisphere, to which nothing was fitted."""
    rows = np.arange(len(side.rows))
    subfield = most_frequent(side.subfield[:], len(side.names))
    return FittedMaps(maps=side, used=rows, rows=rows, subfield=subfield, fits={})
