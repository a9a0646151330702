"""Random intercepts of sites, scanners or families: the term ``(1|site)`` of a formula."""

from hipsta_bids.joints import Extension, Step

EXTENSION = Extension(
    package=__name__,
    meaning="Fit random intercepts of sites, scanners or families in a mixed model.",
    steps=(
        Step(
            name="multilevel",
            flag="(1|...) in the formula",
            names=(),
            condition=f"{__name__}.rows:is_asked",
            plan=f"{__name__}.rows:check_request",
            excludes=("--correction by permutation", "--joint", "--harmonize", "--normative"),
            places={"design": f"{__name__}.rows:with_note"},
            blocks={
                "rows": f"{__name__}.rows:row_models",
                "tables": f"{__name__}.output:tables",
                "methods-after": f"{__name__}.output:methods",
            },
        ),
    ),
)
