"""What a permutation test may exchange: subjects, or of repeated visits whole blocks or visits."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import null_space, orth

from hipsta_bids.errors import ModelError
from hipsta_bids.stats.arrays import Bool, Float, Int
from hipsta_bids.stats.contrasts import Contrast

#: ``whole`` exchanges participants with all their visits, ``within`` the visits of each, ``flip``
#: changes the signs of all visits of a participant.
Exchange = Literal["whole", "within", "flip"]
_TEXT: Mapping[Exchange, str] = {
    "whole": "participants with the same number of visits were exchanged",
    "within": "visits were exchanged within participants",
    "flip": "the signs of all visits of a participant were flipped",
}
#: Length left of a vector of length 1 that is not in the span of some columns.
_OUTSIDE = 1e-6
#: Participants per number of visits, and block, below which too few can change places.
_CLASS = 5
#: Largest share of what is tested between participants where visits are exchanged within them.
_BETWEEN = 0.1
#: Powers of time, from 0, that may be common to all participants.
_POWERS = 4
#: Keys that are worth several passes.
_MOST_COMPARED = 5000


@dataclass(frozen=True, eq=False)
class Visits:
    """Rows of which participants have several."""

    people: Int
    """(rows,) number of each row's participant."""
    times: Float | None = None
    """(rows,) of each visit, any unit, if it is known."""
    slopes: bool = False
    """Whether changes over time differ between participants."""
    blocks: Int | None = None
    """(rows,) number of each participant's block, as of sites, in which participants stay."""

    def take(self, rows: Int) -> "Visits":
        """Keep some rows."""
        times = None if self.times is None else self.times[rows]
        blocks = None if self.blocks is None else self.blocks[rows]
        return replace(self, people=self.people[rows], times=times, blocks=blocks)

    def classes(self) -> Int:
        """(2, rows) number of visits of each row's participant, and the block."""
        sizes = np.unique(self.people, return_inverse=True, return_counts=True)
        blocks = np.zeros_like(self.people) if self.blocks is None else self.blocks
        return np.stack([sizes[2][sizes[1]], blocks])

    def order(self, key: Float | None = None) -> Int:
        """Rows by class, participant and time; participants by keys where given."""
        groups = self.people if key is None else key[self.people]
        times = np.arange(len(groups)) if self.times is None else self.times
        order = np.lexsort((times, self.people, groups, *self.classes()))
        return np.asarray(order, dtype=np.int64)

    def shuffle(self, basis: Float, exchange: Exchange, keys: Float, blocks: Float) -> Float:
        """Shuffle rows of a basis by uniform keys: of participants, and of single rows."""
        if exchange == "flip":
            return flip(basis, keys[self.people])
        result = np.empty_like(basis)
        by_row = np.lexsort((blocks, self.people)), np.argsort(self.people, kind="stable")
        source, target = by_row if exchange == "within" else (self.order(keys), self.order())
        result[target] = basis[source]
        return result


def flip(basis: Float, key: Float) -> Float:
    """Change the signs of rows whose key, uniform between 0 and 1, is in the lower half."""
    signs: Float = np.where(key < 0.5, -1.0, 1.0)[:, None]  # noqa: PLR2004 -- half of them
    return np.asarray(basis * signs, dtype=np.float64)


def shuffle(basis: Float, blocks: Int | None, key: Float) -> Float:
    """Shuffle rows, within blocks; the same as shuffling residuals the other way round.

    Keys are uniform between 0 and 1: their order is the permutation.
    """
    if blocks is None:
        return basis.take(_order(key), axis=0)  # several times as fast as an index
    result = basis.copy()
    result[np.argsort(blocks, kind="stable")] = basis[np.lexsort((key, blocks))]
    return result


def _order(key: Float) -> Int:
    """Sort keys; many by 16 of 48 bits at a time, which takes a third of the time."""
    if len(key) < _MOST_COMPARED:
        return np.argsort(key)
    bits = (key * 2.0**48).astype(np.int64)
    order = np.argsort(bits.astype(np.uint16), kind="stable")
    for passed in (16, 32):
        part = (bits >> passed).astype(np.uint16).take(order)
        order = order.take(np.argsort(part, kind="stable"))
    return order


def split(matrix: Float, contrast: Contrast) -> tuple[Float, Float]:
    """Orthonormal columns that are tested, and that are not, (..., rows, columns) each.

    The product of the former with the data is the estimated contrast.
    """
    tested = matrix @ np.linalg.solve(np.swapaxes(matrix, -1, -2) @ matrix, contrast.weights.T)
    length = np.linalg.norm(tested, axis=-2, keepdims=True)
    tested = tested / length if contrast.n_rows == 1 else np.linalg.qr(tested)[0]
    return tested, np.linalg.qr(matrix @ null_space(contrast.weights))[0]


def spans_constant(matrix: Float, contrast: Contrast) -> bool:
    """Check whether the columns that are not tested can make a constant; else a mean is tested.

    Further weights are of maps as covariates, which are centered.
    """
    columns = matrix @ null_space(contrast.weights[:, : matrix.shape[1]])
    return spans(np.linalg.qr(columns)[0], np.ones(len(matrix)))


def spans(columns: Float, vector: Float) -> bool:
    """Whether orthonormal columns can make a vector."""
    unit = vector / np.linalg.norm(vector)
    return bool(np.linalg.norm(unit - columns @ (columns.T @ unit)) < _OUTSIDE)


def varies_inside(tested: Float, blocks: Int) -> bool:
    """Whether any column (rows, columns) varies inside blocks."""
    inside = np.abs(tested - _block_means(tested, blocks)).max()
    return bool(inside >= _OUTSIDE * np.abs(tested).max())


def varies_between(tested: Float, visits: Visits) -> bool:
    """Whether any column (rows, columns) differs between participants of a block.

    An equal curve of time in all of them does not.
    """
    member = visits.classes()[1][:, None] == np.unique(visits.classes()[1])
    curves = orth(np.hstack([member * power[:, None] for power in _powers(visits, _POWERS)]))
    return not all(spans(curves, column) for column in tested.T)


def _powers(visits: Visits, count: int) -> list[Float]:
    """Powers of time, from 0, (rows,) each."""
    times = np.zeros(len(visits.people)) if visits.times is None else visits.times
    standard = (times - times.mean()) / (float(times.std()) or 1.0)
    return [standard**power for power in range(count)]


def _block_means(columns: Float, blocks: Int) -> Float:
    """Mean of the block that each row is in."""
    numbers = np.unique(blocks, return_inverse=True)[1]
    sums = np.stack([np.bincount(numbers, column) for column in columns.T], axis=1)
    return np.asarray((sums / np.bincount(numbers)[:, None])[numbers], dtype=np.float64)


def choose_exchange(
    matrix: Float, contrast: Contrast, visits: Visits, choice: Literal["auto"] | Exchange
) -> Exchange:
    """Choose the exchange of repeated visits (Winkler et al. 2014, 2015).

    Differences between participants, also in their changes over time, exchange whole blocks;
    changes that all have in common exchange the visits of each participant, which are alike as
    long as changes do not differ between them. With random slopes, and for means, neither holds,
    and signs are flipped.
    """
    tested, nuisance = split(matrix, contrast)
    changes = varies_inside(tested, visits.people)
    means = _block_means(tested, visits.people)
    inside = np.max(np.sum(means**2, axis=0) / np.sum(tested**2, axis=0)) <= _BETWEEN
    whole = _between(tested, nuisance, visits, changes=changes)
    if choice == "auto":
        people = np.unique(visits.people, return_index=True)[1]
        counts = np.unique(visits.classes()[:, people], axis=1, return_counts=True)[1]
        if whole and counts.mean() >= _CLASS:
            return "whole"
        return "within" if inside and not (whole or visits.slopes) else "flip"
    if (choice == "whole" and not whole) or (choice == "within" and not inside):
        problem = "differs between" if choice == "within" else "is the same in all"
        raise ModelError(
            f"permutation: {contrast.name} {problem} participants, which multiplicity.visits"
            f" {choice} does not test; use auto"
        )
    return choice


def exchange_text(
    matrix: Float, contrasts: Sequence[Contrast], visits: Visits, choice: Literal["auto"] | Exchange
) -> str:
    """Word the exchange of each contrast, without a final period."""
    kinds: dict[Exchange, list[str]] = {}
    for contrast in contrasts:
        kinds.setdefault(choose_exchange(matrix, contrast, visits, choice), []).append(
            contrast.name
        )
    texts = (f"for {', '.join(names)}, {_TEXT[kind]}" for kind, names in kinds.items())
    text = "; ".join(texts)
    return text[:1].upper() + text[1:]


def _between(tested: Float, nuisance: Float, visits: Visits, *, changes: bool) -> bool:
    """Whether what is tested differs between participants, by more than time does in all."""
    if changes and visits.times is None:
        return False
    common = _powers(visits, _POWERS if changes else 1)
    model = np.column_stack([tested, nuisance])
    conditions: list[Bool | bool] = [spans(nuisance, c) or not spans(model, c) for c in common]
    return all(conditions)
