"""A mixed model of participants, with a random intercept of each site."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hipsta_bids.errors import ModelError
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.request import Request
from hipsta_bids.stats.arrays import Float, Int
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.design import Design
from hipsta_bids.stats.formula import check_spelling
from hipsta_bids.stats.glm import PointwiseFit, RowModel
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.stats.mixed import fit_mixed

#: With fewer levels, the variance between levels is hardly known (Gelman and Hill 2007, Data
#: analysis using regression and multilevel/hierarchical models, section 12.9).
FEW_LEVELS = 5


@dataclass(frozen=True, eq=False)
class NestedRows(RowModel):
    """A mixed model of rows within levels, as of participants within sites."""

    kind = "linear mixed model"

    def fit(
        self,
        values: Float,
        rows: Int,
        contrasts: tuple[Contrast, ...],
        covariates: Float | None = None,
    ) -> PointwiseFit:
        """Fit some rows of the design at each point, perhaps with maps as covariates."""
        matrix, levels = self.design.matrix[rows], self.design.random[rows]
        return fit_mixed(
            values, matrix, levels, contrasts, self.settings, covariates=covariates, within=True
        )

    def fit_measures(
        self, values: Float, rows: Int, contrasts: tuple[Contrast, ...]
    ) -> PointwiseFit:
        """Fit some rows of the design to each summary measure, as if it were a point."""
        return self.fit(values, rows, contrasts)


def is_asked(request: Request) -> bool:
    """Check whether the formula has a random intercept."""
    return bool(request.model.random)


def check_request(request: Request) -> Request:
    """Return the request; ModelError if a random intercept is not possible with its other parts."""
    name, problem = request.model.random, ""
    if request.comparison.sessions.is_repeated:
        problem = "not with visits as rows (--longitudinal, --endpoint); use --paired"
    elif request.settings.glm.covariance != "ordinary":
        problem = "it assumes equal variances; set glm.covariance to ordinary"
    elif name in closed_formula(request.model.formula).names:
        problem = f"{name} is also a fixed term; remove one of them"
    if problem:
        raise ModelError(f"{request.model.random_term} in the formula: {problem}")
    return request


def row_models(request: Request) -> Iterator[Callable[[Design], RowModel]]:
    """Return what makes the model of the rows of a design."""
    yield partial(_nested_rows, request=request)


def _nested_rows(design: Design, request: Request) -> NestedRows:
    """Make the model; ModelError if the design leaves no variance between levels to estimate."""
    name, problem = request.model.random, ""
    levels, numbers, counts = np.unique(design.random, return_inverse=True, return_counts=True)
    check_spelling(dict(zip(levels.tolist(), counts.tolist(), strict=True)), name)
    columns = np.column_stack([design.matrix, np.eye(len(levels))[numbers]])
    if len(levels) == 1:
        problem = f"all {len(numbers)} complete rows have {name} {levels[0]}; remove it"
    elif counts.max() == 1:
        problem = f"no level of {name} has two participants; remove it"
    elif np.linalg.matrix_rank(columns) == len(design.columns):
        problem = f"fixed terms explain all differences between levels of {name}; remove it"
    if problem:
        raise ModelError(f"{request.model.random_term} in the formula: {problem}")
    return NestedRows(design, request.settings.glm)


def with_note(analysis: Analysis, request: Request) -> Analysis:
    """Note that levels are few."""
    name, count = request.model.random, len(np.unique(analysis.design.random))
    if count >= FEW_LEVELS:
        return analysis
    note = (
        f"{request.model.random_term}: {name} has {count} levels; with fewer than {FEW_LEVELS}, a"
        f" fixed effect (+ {name}) is safer"
    )
    notes = {**analysis.design.notes, "random": note}
    return replace(analysis, design=replace(analysis.design, notes=notes))
