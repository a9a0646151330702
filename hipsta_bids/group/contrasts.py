"""Linear combinations of coefficients that are tested."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Contrast:
    """One hypothesis: that ``weights @ coefficients`` is zero."""

    name: str
    weights: FloatArray
    """(rows, columns of the design); one row is tested by t, several together by F."""

    def __post_init__(self) -> None:
        weights = np.atleast_2d(np.array(self.weights, dtype=np.float64))
        if np.linalg.matrix_rank(weights) < weights.shape[0]:
            raise ModelError(
                f"contrast {self.name!r}: its rows say the same thing twice, or one is all zero;"
                " leave out the redundant row",
                reason="contrast-redundant",
            )
        weights.flags.writeable = False
        object.__setattr__(self, "weights", weights)

    @property
    def n_rows(self) -> int:
        """Degrees of freedom of the hypothesis."""
        return int(self.weights.shape[0])
