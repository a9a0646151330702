"""Sites: effects of sites and scanners are taken out of maps and measures (ComBat)."""

from hipsta_bids.joints import Extension, Step

NAME = "sites"
EXTENSION = Extension(
    package=__name__,
    meaning="Remove effects of sites and scanners from maps and measures.",
    steps=(
        Step(
            name=NAME,
            flag="--harmonize",
            names=("harmonize", "harmonize_model"),
            records=("harmonization",),
            inputs={"harmonize_model": "harmonization"},
            options=f"{__name__}.options:add_options",
            settings=f"{__name__}.options:with_settings",
            setting="harmonization.column",
            condition=f"{__name__}.planning:is_asked",
            plan=f"{__name__}.planning:plan_sites",
            excludes=("map() in the formula", "summary measures in the formula", "--endpoint"),
            places={
                "design": f"{__name__}.planning:without_tests_of_sites",
                "adjust": f"{__name__}.harmonize:adjust",
                "classify": f"{__name__}.harmonize:choose_classified",
            },
            blocks={
                "tables": f"{__name__}.output:tables",
                "methods": f"{__name__}.methods:methods",
                "figures": f"{__name__}.output:figures",
                "source": f"{__name__}.output:source",
                "files": f"{__name__}.output:effect_files",
                "record": f"{__name__}.output:record",
            },
        ),
    ),
    settings=(("group", "harmonization", f"{__name__}.settings:HarmonizationSettings"),),
    sections=f"{__name__}.page:SECTIONS",
)
