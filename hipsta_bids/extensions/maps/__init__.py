"""Maps and volumes of other programs, and masks: beside the sheets of the participant level."""

from hipsta_bids.joints import Extension, Source

EXTENSION = Extension(
    package=__name__,
    meaning="Read maps and volumes of other programs, and mask points of the sheets.",
    sources=(
        Source(options=f"{__name__}.options:add_options", make=f"{__name__}.options:make_sources"),
    ),
)
