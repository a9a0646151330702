"""What the page of an analysis says of its rows."""

from collections.abc import Mapping
from typing import Any

_ENDPOINTS = {
    "ancova": "adjusted for the value at {}",
    "mmrm": "adjusted for the value at {}; visits have any covariance",
    "clda": "arms are equal at {}; visits have any covariance",
}


def describe_rows(comparison: Mapping[str, Any]) -> tuple[str, str] | None:
    """Describe a row of the model, and name the estimate that may be missing."""
    if endpoint := comparison.get("endpoint"):
        text = f"A row is a visit: {_ENDPOINTS[endpoint[0]].format(endpoint[1])}."
        return text, "the model" if endpoint[0] == "ancova" else "the covariance of visits"
    if comparison.get("longitudinal"):
        text = (
            "A row is a visit; the model has random effects, or a covariance of visits (see the "
            "methods paragraph)."
        )
        return text, "the model"
    if comparison.get("pair"):
        first, second = comparison["pair"]
        return f"A row is a participant's change from {first} to {second}.", "the model"
    return None
