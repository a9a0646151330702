"""Templates of registration as JSON objects, so that they can be kept and used again."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from hipsta_bids.errors import ModelError
from hipsta_bids.group.template import Template

_ARRAYS = {"knots", "mean", "components", "center"}
#: JSON has no infinity; that of the penalty's variance is left out.
_INFINITE = "warp_variance"


def templates_to_json(templates: Mapping[str, Template]) -> dict[str, Any]:
    """Spell templates by hemisphere.

    Parameters
    ----------
    templates : mapping of str to Template
    """
    entries = {}
    for hemi, template in templates.items():
        entry = {
            name: value.tolist() if name in _ARRAYS else value
            for name, value in asdict(template).items()
        }
        if not np.isfinite(template.warp_variance):
            entry[_INFINITE] = None
        entries[hemi] = entry
    return {"Description": "template of curvature profiles along x", "Hemispheres": entries}


def templates_from_json(content: Mapping[str, Any], where: str) -> dict[str, Template]:
    """Read templates by hemisphere.

    Parameters
    ----------
    content : mapping
        From :func:`templates_to_json`.
    where : str
        File, for messages.

    Raises
    ------
    ModelError
        If it is no such object.
    """
    try:
        found = {}
        for hemi, entry in content["Hemispheres"].items():
            values = {field.name: entry[field.name] for field in fields(Template)}
            for name in _ARRAYS:
                values[name] = np.array(values[name], dtype=np.float64)
            if values[_INFINITE] is None:
                values[_INFINITE] = np.inf
            found[str(hemi)] = Template(**values)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ModelError(
            f"{where}: not a template ({type(error).__name__}: {error}); use the template.json of"
            " another analysis",
            reason="template-file",
        ) from error
    return found
