"""Agreement: several analyses, programs or protocols side by side, and correlation of maps."""

from hipsta_bids.joints import Command, Extension, Page

#: Record of a comparison of analyses, in its folder.
COMPARISON = "comparison.json"
EXTENSION = Extension(
    package=__name__,
    meaning="Compare finished analyses with each other, with published numbers, or by maps.",
    commands=(
        Command(
            name="compare",
            run=f"{__name__}.commands:run_compare",
            parser=f"{__name__}.commands:compare_parser",
            arguments="FOLDER... OUT",
            meaning="compare finished analyses (group level)",
        ),
        Command(
            name="replicate",
            run=f"{__name__}.commands:run_replicate",
            parser=f"{__name__}.commands:replicate_parser",
            arguments="FOLDER OUT",
            meaning="compare an analysis with Diers et al. (2023)",
        ),
        Command(
            name="correlate",
            run=f"{__name__}.commands:run_correlate",
            parser=f"{__name__}.commands:correlate_parser",
            arguments="MAP MAP OUT",
            meaning="correlate two maps of the group level",
        ),
    ),
    pages=(Page(record=COMPARISON, make=f"{__name__}.page:comparison_page"),),
    protocols=f"{__name__}.several:run_protocols",
    functions=(f"{__name__}.correlate:correlate",),
)
