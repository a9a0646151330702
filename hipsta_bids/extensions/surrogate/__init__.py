"""Thickness in single slices without a mesh: a cross-check of unexpected findings."""

from hipsta_bids.joints import Command, Extension

EXTENSION = Extension(
    package=__name__,
    meaning="Measure thickness in single slices, to check maps.",
    commands=(
        Command(
            name="surrogate",
            run=f"{__name__}.commands:run_surrogate",
            parser=f"{__name__}.commands:surrogate_parser",
            arguments="IN OUT",
            meaning="measure thickness in single slices to check maps",
        ),
    ),
    settings=(("participant", "surrogate", f"{__name__}.settings:SurrogateSettings"),),
    addition=f"{__name__}.groups:describe_groups",
    figures=f"{__name__}.groups:list_figures",
    sections=f"{__name__}.page:SECTIONS",
)
