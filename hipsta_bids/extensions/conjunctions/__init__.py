"""Conjunctions: contrasts of which all have to hold, and equivalence within a margin."""

from hipsta_bids.joints import Extension, Step

NAME = "conjunctions"
EXTENSION = Extension(
    package=__name__,
    meaning="Test that several contrasts hold together, or that a difference is below a margin.",
    steps=(
        Step(
            name=NAME,
            flag="--contrast with & or | |",
            names=(),
            options=f"{__name__}.texts:describe",
            condition=f"{__name__}.texts:is_asked",
            contrasts=f"{__name__}.texts:fitted_contrasts",
            plan=f"{__name__}.texts:plan_conjunctions",
            excludes=("--correction by permutation", "--joint"),
            places=dict.fromkeys(("tests", "summarize"), f"{__name__}.together:combine"),
            blocks={
                "columns": f"{__name__}.together:meaning",
                "methods-after": f"{__name__}.together:methods",
            },
        ),
    ),
)
