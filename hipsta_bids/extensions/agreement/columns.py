"""Meaning of the columns of comparisons, correlations and replications."""

import tomllib
from collections.abc import Mapping
from importlib.resources import files

from hipsta_bids.group.output.tables import COLUMNS

_MEANINGS = tomllib.loads(
    (files("hipsta_bids.extensions.agreement") / "columns.toml").read_text("utf-8")
)
#: Of analyses that are compared.
COMPARISON_COLUMNS: Mapping[str, str] = COLUMNS | _MEANINGS["comparison"]
#: Of a correlation of maps.
CORRELATION_COLUMNS: Mapping[str, str] = _MEANINGS["correlation"]
#: Of published numbers beside the numbers of an analysis.
REPLICATE_COLUMNS: Mapping[str, str] = _MEANINGS["replicate"]
