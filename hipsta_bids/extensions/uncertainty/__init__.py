"""Uncertainty: how much maps vary over perturbed copies of the labels."""

from hipsta_bids.joints import Extension, Measurement

EXTENSION = Extension(
    package=__name__,
    meaning="Estimate the SD of measures from perturbed copies of the labels.",
    measurements=(
        Measurement(
            name="uncertainty",
            options=f"{__name__}.options:add_options",
            after=f"{__name__}.files:estimate",
            is_complete=f"{__name__}.files:has_spread",
            cost=f"{__name__}.options:cost_of",
            tables=("uncertainty",),
            columns=f"{__name__}.page:read_columns",
            pictures=f"{__name__}.page:draw_spread",
        ),
    ),
    settings=(("participant", "uncertainty", f"{__name__}.settings:UncertaintySettings"),),
)
