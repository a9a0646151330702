"""Settings of joint tests."""

from typing import Literal

from hipsta_bids.types import tables


class JointSettings(tables.SettingsTable):
    """Tests of several measures together, by permutation (non-parametric combination)."""

    measures: tables.Texts = ()
    """Maps that are tested together at each point; empty for no joint test."""
    combine: Literal["fisher", "tippett"] = "fisher"
    """``fisher`` adds up the evidence of all measures, ``tippett`` takes the strongest (Winkler et
    al. 2016)."""
    sides: bool = False
    """Whether the left and the right map of a measure are combined too, point by point."""
