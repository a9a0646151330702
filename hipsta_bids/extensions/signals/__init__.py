"""Signals: other volumes on the sheet, and regions drawn on it."""

from hipsta_bids.joints import Extension, Input, Measurement

EXTENSION = Extension(
    package=__name__,
    meaning="Sample other volumes on the sheet, and summarize maps in regions drawn on it.",
    inputs=(
        Input(options=f"{__name__}.options:add_options", make=f"{__name__}.options:find_files"),
    ),
    measurements=(
        Measurement(
            name="maps",
            after=f"{__name__}.files:add_signals",
            is_complete=f"{__name__}.files:is_complete",
        ),
    ),
    settings=(("participant", "maps", f"{__name__}.settings:MapSettings"),),
)
