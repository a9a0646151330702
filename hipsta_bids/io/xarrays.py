"""Labeled arrays of xarray, also arrays that are read when their values are used.

The latter follow https://docs.xarray.dev/en/stable/internals/how-to-add-new-backend.html
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

Variable = tuple[Sequence[str], Any, Mapping[str, Any]]
"""Names of the axes, values, and attributes."""

Read = Callable[[tuple[int, ...]], NDArray[Any] | None]
"""Returns the values at one position of the outer axes, or None where there are none."""


def make_dataset(
    variables: Mapping[str, Variable], coordinates: Mapping[str, Variable], about: Mapping[str, Any]
) -> xr.Dataset:
    """Put arrays under their names; ``units`` and ``long_name`` are among the attributes."""
    data = {name: xr.Variable(*variable) for name, variable in variables.items()}
    axes = {name: xr.Variable(*variable) for name, variable in coordinates.items()}
    return xr.Dataset(data, coords=axes, attrs=dict(about))


def read_later(
    outer: tuple[int, ...], inner: tuple[int, ...], kind: type[np.generic], read: Read
) -> Any:  # noqa: ANN401  (what xarray takes as the values of a variable)
    """Make an array of shape ``(*outer, *inner)`` that reads only the parts used.

    Missing is NaN, False or an empty word.
    """
    return indexing.LazilyIndexedArray(_Later(outer, inner, kind, read))


class _Later(BackendArray):
    """Values in many files, each of which has those of one position of the outer axes."""

    def __init__(
        self, outer: tuple[int, ...], inner: tuple[int, ...], kind: type[np.generic], read: Read
    ) -> None:
        self.shape = (*outer, *inner)
        self.dtype = np.dtype(kind)
        self.count = len(outer)
        self.read = read
        self.missing = {"f": np.nan, "b": False}.get(self.dtype.kind, "")

    def __getitem__(self, key: Any) -> Any:  # noqa: ANN401  (of xarray)
        """Read what is asked for."""
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.OUTER, self._take
        )

    def _take(self, key: tuple[Any, ...]) -> NDArray[Any]:
        indices = [np.arange(n)[part] for n, part in zip(self.shape, key, strict=True)]
        lists = [np.atleast_1d(part) for part in indices]
        outer, inner = lists[: self.count], np.ix_(*lists[self.count :])
        result = np.full([len(part) for part in lists], self.missing, dtype=self.dtype)
        for position in np.ndindex(*(len(part) for part in outer)):
            index = tuple(int(part[i]) for part, i in zip(outer, position, strict=True))
            values = self.read(index)
            if values is not None:
                result[position] = values[inner]
        return result.reshape([part.size for part in indices if part.ndim])
