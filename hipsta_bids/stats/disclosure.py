"""Which summary may leave a site: a summary that holds no number about a few participants.

Contrasts that a site chooses can hold the sum of each product of two columns of the model, and of
each column with each measure. So no cell of the factors, and no combination of the sums, may rest
on fewer participants than ``exchange.min_cell``.
"""

from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from itertools import combinations, product
from typing import NoReturn

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError
from hipsta_bids.stats.arrays import Bool, Float, Int
from hipsta_bids.stats.design import DEPENDENCE, Design
from hipsta_bids.stats.formula import FEW_VALUES, level_labels
from hipsta_bids.stats.settings import ExchangeSettings

#: Share of a sum of squares that belongs to a few participants, if the sum is theirs alone.
_WHOLE_SHARE = 1 - 1e-6
_ZERO = 1e-12  # length of a column
#: Below these shares of the largest value, a weight is taken for zero, step by step.
_STEPS = np.geomspace(0.3, 1e-3, 12)


def check_people(
    designs: Sequence[Design], people: Mapping[str, pd.Series], limits: ExchangeSettings
) -> list[Int]:
    """Refuse designs of which sums are about few participants; return the rows of each cell.

    ``people`` are the variables of the models, the groups first.
    """
    factors = {name for design in designs for name in design.references}
    return check_sums(
        [(design.matrix, design.columns) for design in designs], factors, people, limits
    )


def check_sums(
    models: Sequence[tuple[Float, Sequence[str]]],
    factors: Container[str],
    people: Mapping[str, pd.Series],
    limits: ExchangeSettings,
    weights: Sequence[Float] = (),
) -> list[Int]:
    """Refuse columns, with their names, if sums are about few participants; return rows by cell.

    Sums are of the products of two columns, also with each of the ``weights`` of rows.
    """
    numbers = {
        name: values.to_numpy(dtype=np.float64)
        for name, values in people.items()
        if name not in factors and values.nunique() > FEW_VALUES
    }
    least = limits.min_cell
    cells = check_cells({n: v for n, v in people.items() if n not in numbers}, least)
    cells = cells or {"": np.arange(len(models[0][0]))}
    for (name, values), (cell, rows) in product(numbers.items(), cells.items()):
        if _nearly_alike(values[rows, None], least).any():
            place = f" in {cell}" if cell else ""
            _refuse(f"fewer than {least} participants{place} differ in {name}", name)
    for matrix, names in models:
        _check_columns(
            matrix,
            names,
            list(cells.values()),
            list(numbers.values()),
            limits=limits,
            weights=weights,
        )
    return list(cells.values())


def check_cells(factors: Mapping[str, pd.Series], least: int) -> dict[str, Int]:
    """Refuse small or empty cells of the cross-tabulation of all factors; return rows by cell."""
    levels = pd.DataFrame({n: level_labels(v).fillna("n/a") for n, v in factors.items()})
    texts = levels.apply(lambda column: f"{column.name}=" + column)
    for size in range(1, len(factors) + 1):
        for names in map(list, combinations(factors, size)):
            counts = Counter(texts[names].itertuples(index=False, name=None))
            for cell in product(*(sorted(set(texts[name])) for name in names)):
                if counts[cell] < least:
                    place = f" in {', '.join(cell[:-1])}" if size > 1 else ""
                    _refuse(f"{cell[-1]}{place} holds fewer than {least} participants", names[-1])
    joined = texts.apply(", ".join, axis=1).to_numpy() if len(texts) else np.zeros(0)
    return {cell: np.flatnonzero(joined == cell) for cell in dict.fromkeys(joined)}


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
    columns: Float,
    names: Sequence[str],
    cells: Sequence[Int],
    numbers: Sequence[Float],
    *,
    limits: ExchangeSettings,
    weights: Sequence[Float],
) -> None:
    """Refuse few residual degrees of freedom, high leverage, and sums of few participants."""
    # A level that only other sites have is a column of zeros.
    matrix = columns / np.maximum(np.linalg.norm(columns, axis=0), _ZERO)
    basis = _span(matrix)
    leverage = float(np.max(np.sum(basis**2, axis=1)))
    first, second = np.triu_indices(basis.shape[1])
    pairs = basis[:, first] * basis[:, second]
    sums = [basis, pairs, *(weight[:, None] * pairs for weight in weights)]
    sums += [np.stack([x, x**2], axis=1) for x in numbers]  # means and standard deviations
    products = _span(np.hstack(sums))
    (n, count), n_sums = matrix.shape, products.shape[1]
    # Combinations of so many sums can be about any few participants.
    if n - count < limits.min_residual_df or n - n_sums < limits.min_cell - 1:
        raise ModelError(
            f"--export-summary: {n} participants are too few for {count} columns ({n_sums} "
            "sums); remove variables from the shared model"
        )
    if leverage > limits.max_leverage:
        raise ModelError(
            f"--export-summary: one participant determines its own fitted value by {leverage:.0%};"
            " look for an extreme value of a covariate"
        )
    for rows in _small_sums(products, limits.min_cell - 1):
        if any(np.isin(rows, cell).all() and _plain(products, cell, numbers) for cell in cells):
            continue
        spread = (matrix - np.median(matrix, axis=0)) ** 2
        shares = spread[rows].sum(axis=0) / np.maximum(spread.sum(axis=0), _ZERO)
        name = names[int(np.argmax(shares))]
        _refuse(f"sums of {name} are about fewer than {limits.min_cell} participants", name)


def _span(columns: Float) -> Float:
    """Orthonormal basis (rows, rank) of columns, but of those that are zero."""
    lengths = np.linalg.norm(columns, axis=0)
    nonzero = lengths > _ZERO
    basis, sizes, _ = np.linalg.svd(columns[:, nonzero] / lengths[nonzero], full_matrices=False)
    return np.asarray(basis[:, sizes > DEPENDENCE * sizes[0]])


def _small_sums(basis: Float, count: int) -> Iterator[Int]:
    """Find rows, at most ``count``, outside of which some combination of columns is zero.

    One of them has a leverage of ``1 / count`` or more. From each such row, reweighted least
    squares look for the combination with the fewest rows (Gorodnitsky and Rao 1997).
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
    """Check whether the known sums of a cell are its count and sums of numbers: about all in it."""
    sums = np.zeros((len(basis), 1 + len(numbers)))
    sums[cell] = np.column_stack([np.ones(len(cell)), *(x[cell] - x[cell].mean() for x in numbers)])
    is_known = np.sum((basis.T @ sums) ** 2, axis=0) > _WHOLE_SHARE * np.sum(sums**2, axis=0)
    n_known = np.sum(np.linalg.svd(basis[cell], compute_uv=False) ** 2 > _WHOLE_SHARE)
    return bool(is_known.any() and _span(sums[:, is_known]).shape[1] == n_known)


def _refuse(problem: str, name: str) -> NoReturn:
    raise ModelError(
        f"--export-summary: {problem}; merge levels, or remove {name} from the shared model"
    )
