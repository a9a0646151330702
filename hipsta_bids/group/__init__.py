"""Group level: registration of profiles, point-wise models, classification.

Called as a function, ``hipsta_bids.group(maps, table, formula)``, it fits a model to arrays: see
:func:`hipsta_bids.api.models.group`.
"""

import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

from hipsta_bids.joints import load


def _function() -> Callable[..., Any]:
    function: Callable[..., Any] = load("hipsta_bids.api.models:group")
    return function


class _Package(ModuleType):
    """A package with the call, signature and text of the function that it hides by its name."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:  # noqa: ANN401  (of the function)
        """Fit a model to arrays, see :func:`hipsta_bids.api.models.group`."""
        return _function()(*arguments, **named)

    @property
    def __signature__(self) -> inspect.Signature:
        return inspect.signature(_function())

    @property
    def __doc__(self) -> str | None:  # type: ignore[override]  # a plain attribute of other modules
        return _function().__doc__


sys.modules[__name__].__class__ = _Package
