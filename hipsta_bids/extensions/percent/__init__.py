"""Percent: differences of groups in percent of the mean of the reference group."""

from hipsta_bids.joints import Extension, Step

NAME = "percent"
EXTENSION = Extension(
    package=__name__,
    meaning="Write differences of groups in percent of the mean of the reference group.",
    steps=(
        Step(
            name=NAME,
            flag="--percent",
            names=(NAME,),
            options=f"{__name__}.options:add_option",
            condition=f"{__name__}.ratio:is_asked",
            plan=f"{__name__}.ratio:choose_groups",
            places={"summarize": f"{__name__}.ratio:add_percent"},
            blocks={
                "columns": f"{__name__}.ratio:meaning",
                "methods-after": f"{__name__}.ratio:methods",
            },
        ),
    ),
)
