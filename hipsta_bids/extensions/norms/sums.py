"""Norms from sums over participants, which sites can merge without values of participants.

The model is that of :mod:`norms` with normal distributions. Of each site it needs the sums of
products of the columns (constant, age, sex) with each other and with the values, and the same sums
with age as a weight. The variance of a site at an age follows from the squared residuals, which are
sums as well; ages count by their first four moments.
"""

import numpy as np

from hipsta_bids.extensions.norms.centiles import Norms, People, age_columns
from hipsta_bids.stats.arrays import Bool, Float
from hipsta_bids.stats.solve import solve_points

#: Steps of the fits, and the relative change of weights that ends them.
_STEPS, _SETTLED = 50, 1e-12
_LARGEST_STEP = 1.0  # of the change of the logarithm of the SD
#: Least share of a sum of squares that residuals have, but for rounding.
_VARIES = 1e-10


def columns_of(people: People, knots: Float) -> Float:
    """(visits, columns) constant, spline of age and sex; the second one is age from 0 to 1."""
    constant = np.ones(len(people.age))
    return np.column_stack([constant, age_columns(people.age, knots), people.sex])


def sum_columns(people: People, n_sites: int, knots: Float) -> Float:
    """(sites, 2, columns, columns) sums of products, without and with age as a weight."""
    columns, blocks = columns_of(people, knots), []
    for site in range(n_sites):
        rows = columns[people.site == site]
        blocks.append([rows.T @ rows, (rows[:, [1]] * rows).T @ rows])
    return np.array(blocks)


def sum_values(values: Float, people: People, n_sites: int, knots: Float) -> Float:
    """(sites, 2, columns + 1, points) sums of products with the values; the last row has squares.

    A point has sums at a site where all its visits have a value; else they are NaN.
    """
    columns, blocks = columns_of(people, knots), []
    for site in range(n_sites):
        members = people.site == site
        rows, numbers = columns[members], values[members]
        blocks.append(
            [
                np.vstack([weighted.T @ numbers, np.sum(weighted[:, [0]] * numbers**2, axis=0)])
                for weighted in (rows, rows[:, [1]] * rows)
            ]
        )
    return np.array(blocks)


def fit_values(values: Float, people: People, n_sites: int, knots: Float) -> Norms:
    """Fit norms to values (visits, points) by their sums alone."""
    rows = people.known
    values, people = values[rows], people.take(rows)
    sums = sum_values(values, people, n_sites, knots)
    return fit_sums(sum_columns(people, n_sites, knots), sums, knots)


def fit_sums(grams: Float, sums: Float, knots: Float) -> Norms:
    """Fit norms to what :func:`sum_columns` and :func:`sum_values` give for all sites."""
    present: Bool = np.asarray(np.isfinite(sums).all(axis=(1, 2)))
    sums = np.where(present[:, None, None], sums, 0.0)
    products, squares = sums[:, :, :-1], sums[:, :, -1]
    n = grams[:, 0, :1, 0] * present
    n_sites, n_columns = grams.shape[0], grams.shape[2]
    # From the constants of all sites and the common slopes to the coefficients of a site.
    select = np.zeros((n_sites, n_columns, n_sites + n_columns - 1))
    select[np.arange(n_sites), 0, np.arange(n_sites)] = 1.0
    select[:, 1:, n_sites:] = np.eye(n_columns - 1)
    wide = np.einsum("sia,swij,sjb->swab", select, grams, select, optimize=True)
    right = np.einsum("sia,sip->spa", select, products[:, 0])
    weight = present.astype(np.float64)
    for _ in range(_STEPS):
        gram = np.einsum("sp,sab->pab", weight, wide[:, 0])
        inverse = np.linalg.pinv(gram, hermitian=True)
        solution = solve_points(gram, np.einsum("sp,spa->pa", weight, right), 0.0)
        beta = np.einsum("sia,ap->sip", select, solution)
        square: Float = squares - 2 * np.einsum("swip,sip->swp", products, beta)
        square += np.einsum("sip,swij,sjp->swp", beta, grams, beta, optimize=True)
        present = present & (square[:, 0] > _VARIES * squares[:, 0])
        # As residuals are when one minus the leverage divides their squares.
        leverage = weight[:, None] * np.einsum("pab,swba->swp", inverse, wide)
        counts = grams[:, :, :1, 0]  # without and with age as a weight
        square = np.where(present[:, None], square * counts, 1.0)
        square /= np.where(present[:, None], counts - leverage, 1.0)
        previous, weight = weight, np.where(present, n / square[:, 0], 0.0)
        change = np.abs(weight / np.where(present, previous, 1.0) - 1)
        if change.max(where=present, initial=0.0) < _SETTLED:
            break
    log_sd, slope = _spread(grams, square, weight)
    part = n / np.maximum(n.sum(axis=0), 1)
    constants = np.where(present, beta[:, 0], np.nan)
    log_sd = np.where(present, log_sd, np.nan)
    average = [np.nansum(part * array, axis=0) for array in (constants, log_sd)]
    return Norms(
        knots=knots,
        mean=np.where(present.any(axis=0), np.vstack([average[0], solution[n_sites:]]), np.nan),
        spread=np.vstack([average[1], slope]),
        shape=np.zeros((2, len(slope))),
        shift=constants - average[0],
        scale=np.exp(log_sd - average[1]),
        n=n.astype(np.int64),
    )


def _spread(grams: Float, square: Float, weight: Float) -> tuple[Float, Float]:
    """Logarithm of the SD of sites (sites, points) at age 0, and its change (points,) to age 1.

    The change is the one at which squared residuals of sites have the mean age that they have. Two
    ages with the mean, SD and skewness of a site's stand for its participants.
    """
    n, first, second = grams[:, 0, 0, 0], grams[:, 0, 0, 1], grams[:, 0, 1, 1]
    mean = first / n
    variance = np.maximum(second / n - mean**2, 1e-12)
    third = grams[:, 1, 1, 1] / n - 3 * mean * second / n + 2 * mean**3
    middle = third / (2 * variance)
    reach = np.sqrt(variance + middle**2)
    ages = np.stack([mean + middle - reach, mean + middle + reach], axis=1)[:, :, None]
    share = (
        np.stack([reach + middle, reach - middle], axis=1)[:, :, None] / (2 * reach)[:, None, None]
    )
    slope = np.zeros(square.shape[2])
    for _ in range(_STEPS):
        tilted = share * np.exp(2 * slope * ages)
        total = tilted.sum(axis=1)
        center = (tilted * ages).sum(axis=1) / total
        width = (tilted * ages**2).sum(axis=1) / total - center**2
        gap = np.sum(weight * (square[:, 1] - square[:, 0] * center), axis=0)
        total_width = 2 * np.sum(weight * square[:, 0] * width, axis=0)
        # Points that no site has, or where nobody differs, have no slope.
        step = gap / np.where(total_width > 0, total_width, np.nan)
        step = np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
        slope += step
        if not (np.abs(step) > _SETTLED).any():
            break
    tilted = share * np.exp(2 * slope * ages)
    return np.log(square[:, 0] / (n[:, None] * tilted.sum(axis=1))) / 2, slope
