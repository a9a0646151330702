"""Classification of each pair of groups, as in the paper's tables."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError
from hipsta_bids.group.classification import ModelComparison, compare_models
from hipsta_bids.group_settings import ClassificationSettings

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class PairComparison:
    """Two groups told apart by a base model, and by one with measures added."""

    control: str
    case: str
    comparison: ModelComparison
    is_case: NDArray[np.bool_]
    """(subjects,) in the order of the models' scores."""
    n_incomplete: int
    """Subjects of the two groups left out of both models, as they lack a value."""


def compare_pairs(
    groups: NDArray[np.str_],
    base: FloatArray,
    added: FloatArray,
    settings: ClassificationSettings,
    *,
    order: Sequence[str],
) -> list[PairComparison]:
    """Compare the two models in each pair of groups, on the same complete subjects.

    Parameters
    ----------
    groups : ndarray of str, shape (subjects,)
        Group of each.
    base : ndarray, shape (subjects, columns)
        Measures and covariates of the base model, without an intercept; NaN is missing.
    added : ndarray, shape (subjects, columns)
        Measures that come on top.
    settings : ClassificationSettings
        Limits, folds and iterations.
    order : sequence of str
        Groups, from least to most affected: the later one of a pair are the cases.

    Raises
    ------
    ModelError
        If a group is unknown, or a pair cannot be compared; names the pair.
    """
    if unknown := sorted(set(order) - set(groups.tolist())):
        raise ModelError(
            f"classification: nobody is in group {', '.join(unknown)}; known are"
            f" {', '.join(sorted(set(groups.tolist())))}",
            reason="unknown-level",
        )
    complete = np.isfinite(base).all(axis=1) & np.isfinite(added).all(axis=1)
    results = []
    for control, case in combinations(order, 2):
        both = (groups == control) | (groups == case)
        used = both & complete
        matrix = np.column_stack([np.ones(used.sum()), base[used]])
        try:
            found = compare_models(matrix, added[used], groups[used] == case, settings)
        except ModelError as error:
            raise ModelError(f"{control} against {case}: {error}", reason=error.reason) from error
        results.append(
            PairComparison(
                control=control,
                case=case,
                comparison=found,
                is_case=groups[used] == case,
                n_incomplete=int((both & ~complete).sum()),
            )
        )
    return results
