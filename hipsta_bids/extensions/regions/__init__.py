"""Head and tail on one sheet with the body, and HippUnfold's rectangle (experimental)."""

from hipsta_bids.joints import Command, Extension, Region

_MEASURE = f"{__name__}.whole:measure_region"
EXTENSION = Extension(
    package=__name__,
    meaning="Measure head and tail with the body, and move maps to HippUnfold's surfaces.",
    commands=(
        Command(
            name="resample",
            run=f"{__name__}.commands:run_resample",
            parser=f"{__name__}.commands:resample_parser",
            arguments="MAP... OUT",
            meaning="move maps to HippUnfold's surfaces, or from there",
        ),
    ),
    regions=(
        Region(name="headbody", measure=_MEASURE),
        Region(name="whole", measure=_MEASURE, meaning="with head and tail"),
    ),
)
