"""Trials: agreement of repeated sessions, and sample sizes."""

from hipsta_bids.joints import Extension, Question

#: Options that only sample sizes have.
POWER_ONLY = ("power_level", "dropout", "allocation", "visits")
EXTENSION = Extension(
    package=__name__,
    meaning="Measure the agreement of sessions, and find how many participants a trial needs.",
    questions=(
        Question(
            flags=("retest", "power"),
            dependents=(*POWER_ONLY, "among"),
            without="--retest or --power",
            options=f"{__name__}.options:add_options",
            run=f"{__name__}.options:run",
            settings=f"{__name__}.options:given_settings",
        ),
    ),
    settings=(
        ("group", "retest", f"{__name__}.settings:RetestSettings"),
        ("group", "power", f"{__name__}.settings:PowerSettings"),
    ),
    sections=f"{__name__}.page:SECTIONS",
)
