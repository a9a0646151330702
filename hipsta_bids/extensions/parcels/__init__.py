"""Parcels: means of maps over regions of the sheet, as summary measures of the group level."""

from hipsta_bids.joints import Extension, Source

#: Values of the option that are no files: subfields, and their thirds along the long axis.
SUBFIELDS, THIRDS = "subfields", "subfields-axis"
EXTENSION = Extension(
    package=__name__,
    meaning="Test means of maps over regions of the sheet.",
    sources=(
        Source(options=f"{__name__}.options:add_options", make=f"{__name__}.means:make_sources"),
    ),
    addition=f"{__name__}.means:prepare_tables",
    figures=f"{__name__}.figures:list_figures",
    sections=f"{__name__}.figures:SECTIONS",
)
