"""Group level: registration of profiles, point-wise models, classification.

Called as a function, ``hipsta_bids.group(maps, table, formula)``, it fits a model to arrays: see
:func:`hipsta_bids.group.questions.models.group`.
"""

import sys
from types import ModuleType
from typing import Any


class _Package(ModuleType):
    """A package that can be called: a function of its name would be hidden by it."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:  # noqa: ANN401  (of what is called)
        """Fit a model to arrays, see :func:`hipsta_bids.group.questions.models.group`."""
        from hipsta_bids.group.questions.models import group  # noqa: PLC0415  (most imports need no model)

        return group(*arguments, **named)


sys.modules[__name__].__class__ = _Package
