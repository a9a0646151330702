"""Settings of meta-analyses."""

from typing import Annotated, Literal

from pydantic import Field

from hipsta_bids.types import tables


class MetaSettings(tables.SettingsTable):
    """Summaries of several sites become one result."""

    random: Literal["reml", "reml-adhoc", "dl"] = "reml"
    """Random effects. ``reml``: variance between sites by restricted maximum likelihood, limits by
    Knapp and Hartung 2003 (``knha`` in metafor). ``reml-adhoc``: the same, but no standard error
    below the uncorrected one, which is conservative. ``dl``: DerSimonian and Laird 1986, with
    normal tests."""
    min_sites: Annotated[int, Field(ge=2)] = 2
    """Fewest sites with an estimate at a point."""
    confidence: tables.OpenFraction = 0.95
    """Coverage of two-sided confidence and prediction limits, fraction."""
