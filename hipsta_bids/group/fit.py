"""Maps of one hemisphere, or of a difference of both, and the model at each point."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError
from hipsta_bids.group.data import PARTICIPANT, Float, Int, SideMaps
from hipsta_bids.group.design import Design
from hipsta_bids.group.formula import Contrast
from hipsta_bids.group.glm import PointTest, PointwiseFit, f_limits, fit_points, t_limits
from hipsta_bids.group.mixed import MixedFit, MixedTest, fit_mixed
from hipsta_bids.group.settings import GroupSettings

# One design for maps and for summary measures, whether its rows are independent or not.


#: Contrast of what all rows have in common.
MEAN = "mean"


@dataclass(frozen=True, eq=False)
class RowModel:
    """A design, and whose row is whose if participants have several."""

    design: Design
    participants: NDArray[np.str_] | None = None
    """(rows,) None if rows are independent: a linear model."""
    times: Float | None = None
    """(rows,) of each visit, for random slopes; else random intercepts."""

    def fit(
        self, values: Float, rows: Int, contrasts: tuple[Contrast, ...], settings: GroupSettings
    ) -> PointwiseFit:
        """Fit some rows of the design at each point.

        ``values`` NaN is missing.
        """
        matrix = self.design.matrix[rows]
        if self.participants is None:
            return fit_points(values, matrix, contrasts, settings.glm)
        times = None if self.times is None else self.times[rows]
        fit = fit_mixed(
            values,
            matrix,
            self.participants[rows],
            contrasts,
            settings.longitudinal,
            times=times,
        )
        return _as_pointwise(fit, settings.longitudinal.confidence)


def longitudinal_model(
    design: Design, table: pd.DataFrame, time: str | None, settings: GroupSettings
) -> RowModel:
    """Tell a mixed model whose visit is whose."""
    if settings.glm.covariance != "ordinary":
        raise ModelError(
            "longitudinal model: it assumes equal variances; set glm.covariance to ordinary",
            reason="longitudinal-covariance",
        )
    own = table.iloc[design.rows]
    times = None
    if settings.longitudinal.random == "slope":
        if time is None:
            raise ModelError(
                "longitudinal model: random slopes need the time of each session; give a column"
                f" {settings.longitudinal.time_columns[0]} or acq_time in sessions.tsv",
                reason="no-time",
            )
        times = own[time].to_numpy(dtype=np.float64)
        if not np.isfinite(times).all():
            lacking = ", ".join(map(str, own.index[~np.isfinite(times)][:8]))
            raise ModelError(f"longitudinal model: no {time} of {lacking}", reason="no-time")
    return RowModel(design, own[PARTICIPANT].to_numpy(dtype=np.str_), times)


def with_mean(design: Design) -> tuple[Contrast, ...]:
    """Contrasts of a design, with that of the model's mean over all rows in front."""
    mean = Contrast(MEAN, design.matrix.mean(axis=0))
    same = [
        one
        for one in design.contrasts
        if one.name == MEAN or (one.n_rows == 1 and np.allclose(one.weights, mean.weights))
    ]
    return design.contrasts if same else (mean, *design.contrasts)


def _as_pointwise(fit: MixedFit, confidence: float) -> PointwiseFit:
    """Word a mixed model as a linear one, with the standard deviation of single visits."""
    sigma = np.sqrt(fit.residual_variance + fit.participant_variance)
    tests = tuple(_as_test(test, sigma, confidence) for test in fit.tests)
    return PointwiseFit(fit.coefficients, sigma, fit.n, tests)


def _as_test(test: MixedTest, sigma: Float, confidence: float) -> PointTest:
    squared = test.t**2
    limits = np.stack(t_limits(test.t, test.df, confidence)) * test.se / sigma
    eta_limits = np.stack(f_limits(squared, 1, test.df, confidence))
    return PointTest(
        contrast=test.contrast,
        statistic=test.t,
        p=test.p,
        df=test.df,
        estimate=test.estimate[None],
        se=test.se[None],
        cohen_d=test.estimate / sigma,
        cohen_d_limits=limits,
        eta_squared=squared / (squared + test.df),
        eta_squared_limits=eta_limits / (eta_limits + test.df),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedMaps:
    """What was fitted, and the fit."""

    maps: SideMaps
    """Of all rows of the model's table that have them."""
    used: Int
    """Sheets that the model is fitted to, as places in ``maps``."""
    rows: Int
    """Rows of the design of the sheets used."""
    subfield: Int
    """(x, y) most frequent subfield, place in ``maps.names``; -1 where there is none."""
    fits: Mapping[str, PointwiseFit]
    """By measure."""

    def values(self, measure: str) -> Float:
        """(sheets used, points) of one measure."""
        return _values(self.maps.maps[measure], self.used)


def fit_maps(
    hemi: str,
    side: SideMaps,
    model: RowModel,
    settings: GroupSettings,
    *,
    contrasts: tuple[Contrast, ...] | None = None,
) -> FittedMaps:
    """Fit a model at each point of all maps of a hemisphere."""
    _, used, rows = np.intersect1d(
        side.rows, model.design.rows, assume_unique=True, return_indices=True
    )
    tested = model.design.contrasts if contrasts is None else contrasts
    try:
        fits = {
            name: model.fit(_values(maps, used), rows, tested, settings)
            for name, maps in side.maps.items()
        }
    except ModelError as error:
        raise ModelError(f"hemisphere {hemi}: {error}", reason=error.reason) from error
    for name, fit in fits.items():
        if not np.isfinite(fit.sigma).any():
            raise ModelError(
                f"hemisphere {hemi}: no point of the {name} maps has enough values for the model;"
                " look at the sheets, or use a smaller model",
                reason="all-points-invalid",
            )
    return FittedMaps(
        maps=side,
        used=np.asarray(used, dtype=np.int64),
        rows=np.asarray(rows, dtype=np.int64),
        subfield=most_frequent(side.subfield[used], len(side.names)),
        fits=fits,
    )


def _values(maps: Float, used: Int) -> Float:
    own = maps if len(used) == len(maps) else maps[used]
    return own.reshape(len(used), -1)


def most_frequent(labels: NDArray[np.int8], count: int) -> Int:
    """Most frequent label at each point."""
    if not count:
        return np.full(labels.shape[1:], -1, dtype=np.int64)
    votes = np.stack([(labels == label).sum(axis=0) for label in range(count)])
    return np.where(votes.max(axis=0) > 0, votes.argmax(axis=0), -1).astype(np.int64)
