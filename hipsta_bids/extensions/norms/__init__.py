"""Norms: centiles by age, sex and site, and scores of other participants by them."""

from hipsta_bids.joints import Extension, Question, Step

STEP = "w-scores"
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
    steps=(
        Step(
            name=STEP,
            flag="--normative",
            names=("normative",),
            options=f"{__name__}.options:add_normative",
            condition=f"{__name__}.scoring:is_asked",
            settings=f"{__name__}.options:check_normative",
            comparison=("normative",),
            plan=f"{__name__}.scoring:choose_reference",
            excludes=(
                "map() in the formula",
                "summary measures in the formula",
            ),
            places={"score": f"{__name__}.scoring:score_cohort"},
            blocks={
                "tables": f"{__name__}.scoring:tables",
                "methods-after": f"{__name__}.methods:scores_text",
                "files": f"{__name__}.scoring:score_files",
            },
        ),
    ),
    settings=(
        ("group", "norms", f"{__name__}.settings:NormSettings"),
        ("group", "exchange", "hipsta_bids.stats.settings:ExchangeSettings"),
    ),
    sections=f"{__name__}.page:SECTIONS",
)
