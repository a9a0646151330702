"""Which summary may leave a site: a summary that holds no number about a few participants.

Whoever has a summary has the sum of each product of two columns of the model, and of each column
with each measure. So no cell of the factors, and no combination of the sums, may rest on fewer
participants than ``exchange.min_cell``.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, product
from typing import NoReturn

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError
from hipsta_bids.group.design.formula import FEW_VALUES, level_labels
from hipsta_bids.group.design.model import DEPENDENCE, Design
from hipsta_bids.group.design.settings import ExchangeSettings
from hipsta_bids.group.stats.arrays import Bool, Float, Int

#: Share of a sum of squares that belongs to a few participants, if the sum is theirs alone.
_WHOLE_SHARE = 1 - 1e-6
#: Length of a column that is zero but for rounding.
_ZERO = 1e-12
#: Below these shares of the largest value, a weight is taken for zero, step by step.
_STEPS = np.geomspace(0.3, 1e-3, 12)


def check_people(
    designs: Sequence[Design], people: Mapping[str, pd.Series], limits: ExchangeSettings
) -> list[Int]:
    """Refuse models of which sums are about few participants; return the rows of each cell.

    ``people`` are the variables of the models, the groups first. ModelError with what is too small,
    where, and what to try.
    """
    least = limits.min_cell
    factors = {name for design in designs for name in design.references}
    numbers = {
        name: values.to_numpy(dtype=np.float64)
        for name, values in people.items()
        if name not in factors and values.nunique() > FEW_VALUES
    }
    cells = check_cells({n: v for n, v in people.items() if n not in numbers}, least)
    cells = cells or {"": np.arange(len(designs[0].matrix))}
    for (name, values), (cell, rows) in product(numbers.items(), cells.items()):
        if _nearly_alike(values[rows, None], least).any():
            place = f" in {cell}" if cell else ""
            _refuse(f"fewer than {least} participants{place} differ in {name}", name)
    for design in designs:
        _check_columns(design, list(cells.values()), list(numbers.values()), limits)
    return list(cells.values())


def check_cells(factors: Mapping[str, pd.Series], least: int) -> dict[str, Int]:
    """Refuse small or empty cells of the cross-tabulation of all factors; return rows by cell."""
    levels = {name: level_labels(values).fillna("n/a") for name, values in factors.items()}
    for size in range(1, len(levels) + 1):
        for names in combinations(levels, size):
            counts = Counter(zip(*(levels[name] for name in names), strict=True))
            for cell in product(*(sorted(set(levels[name])) for name in names)):
                if counts[cell] < least:
                    *outer, level = (f"{n}={x}" for n, x in zip(names, cell, strict=True))
                    place = f" in {', '.join(outer)}" if outer else ""
                    _refuse(f"{level}{place} holds fewer than {least} participants", names[-1])
    count = len(next(iter(levels.values()), ()))
    named = [", ".join(f"{n}={v.iloc[row]}" for n, v in levels.items()) for row in range(count)]
    return {cell: np.flatnonzero(np.array(named) == cell) for cell in dict.fromkeys(named)}


def is_traceable(values: Float, cells: Sequence[Int], least: int) -> Bool:
    """(columns,) whether a measure has few different values, or few in a cell differ in it."""
    distinct = 1 + np.sum(np.diff(np.sort(values, axis=0), axis=0) > 0, axis=0)
    is_alike = [_nearly_alike(values[rows], least) for rows in cells]
    return np.asarray((distinct <= FEW_VALUES) | np.any(is_alike, axis=0))


def _nearly_alike(values: Float, least: int) -> Bool:
    """(columns,) whether all rows have the same value, or of many rows all but a few."""
    ordered, n = np.sort(values, axis=0), len(values)
    size = n - least + 1 if n >= 2 * least else n
    return np.asarray((ordered[size - 1 :] == ordered[: n - size + 1]).any(axis=0))


def _check_columns(
    design: Design, cells: Sequence[Int], numbers: Sequence[Float], limits: ExchangeSettings
) -> None:
    """Refuse few residual degrees of freedom, high leverage, and sums of few participants."""
    matrix, least = design.matrix, limits.min_residual_df
    basis = _span(matrix / np.linalg.norm(matrix, axis=0))
    if len(matrix) - matrix.shape[1] < least:
        raise ModelError(
            f"--export-summary: {len(matrix)} participants are too few for {matrix.shape[1]}"
            f" columns; at least {matrix.shape[1] + least} are needed"
        )
    leverage = float(np.max(np.sum(basis**2, axis=1)))
    if leverage > limits.max_leverage:
        raise ModelError(
            f"--export-summary: one participant determines its own fitted value by {leverage:.0%};"
            " look for an extreme value of a covariate"
        )
    first, second = np.triu_indices(basis.shape[1])
    sums = [basis, basis[:, first] * basis[:, second]]
    sums += [np.stack([x, x**2], axis=1) for x in numbers]  # means and standard deviations
    products = _span(np.hstack(sums))
    for rows in _small_sums(products, limits.min_cell - 1):
        if any(np.isin(rows, cell).all() and _plain(products, cell, numbers) for cell in cells):
            continue
        spread = (matrix - np.median(matrix, axis=0)) ** 2
        shares = spread[rows].sum(axis=0) / np.maximum(spread.sum(axis=0), np.finfo(float).tiny)
        name = design.columns[int(np.argmax(shares))]
        _refuse(f"sums of {name} are about fewer than {limits.min_cell} participants", name)


def _span(columns: Float) -> Float:
    """Orthonormal basis (rows, rank) of columns, but of those that are zero."""
    lengths = np.linalg.norm(columns, axis=0)
    nonzero = lengths > _ZERO
    basis, sizes, _ = np.linalg.svd(columns[:, nonzero] / lengths[nonzero], full_matrices=False)
    return np.asarray(basis[:, sizes > DEPENDENCE * sizes[0]])


def _small_sums(basis: Float, count: int) -> Iterator[Int]:
    """Find rows, at most ``count``, outside of which some combination of columns is zero.

    One of these rows has a leverage of ``1 / count`` or more. From each row with that leverage,
    reweighted least squares look for the combination with the fewest rows (Gorodnitsky and Rao
    1997).
    """
    for row in np.flatnonzero(np.sum(basis**2, axis=1) >= 1 / count - DEPENDENCE):
        values = basis @ basis[row]
        for step in _STEPS:
            weighted = basis.T / ((values / np.max(np.abs(values))) ** 2 + step**2) @ basis
            values = basis @ np.linalg.solve(weighted, basis[row])
        rows = np.argsort(-np.abs(values))[:count]
        if np.linalg.norm(basis[rows], 2) ** 2 > _WHOLE_SHARE:
            yield rows[np.abs(values[rows]) > _STEPS[-1] * np.max(np.abs(values))]


def _plain(basis: Float, cell: Int, numbers: Sequence[Float]) -> bool:
    """Tell whether the sums of a cell are its count and sums of numbers as they are.

    These are about all participants of the cell, though some combination is zero for most.
    """
    sums = np.zeros((len(basis), 1 + len(numbers)))
    centered = [x[cell] - x[cell].mean() for x in numbers]
    sums[cell] = np.stack([np.ones(len(cell)), *centered], axis=1)
    is_known = np.sum((basis.T @ sums) ** 2, axis=0) > _WHOLE_SHARE * np.sum(sums**2, axis=0)
    n_known = np.sum(np.linalg.svd(basis[cell], compute_uv=False) ** 2 > _WHOLE_SHARE)
    return bool(is_known.any() and _span(sums[:, is_known]).shape[1] == n_known)


def _refuse(problem: str, name: str) -> NoReturn:
    raise ModelError(
        f"--export-summary: {problem}; merge levels, or leave {name} out of the shared model"
    )
