"""Norms: centiles by age, sex and site, and scores of other participants by them."""

from hipsta_bids.joints import Extension, Question

EXTENSION = Extension(
    package=__name__,
    meaning="Fit norms of measures by age, sex and site, and score participants by them.",
    questions=(
        Question(
            flags=("fit_norms", "norms"),
            dependents=("controls", "among"),
            without="--norms",
            options=f"{__name__}.options:add_options",
            run=f"{__name__}.options:run",
        ),
    ),
    settings=(
        ("norms", f"{__name__}.settings:NormSettings"),
        ("exchange", "hipsta_bids.stats.settings:ExchangeSettings"),
    ),
    columns=f"{__name__}.columns:COLUMNS",
    sections=f"{__name__}.page:SECTIONS",
    has_templates=True,
)
