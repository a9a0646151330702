"""Combination: several measures, or both sides, are tested together at each point."""

from hipsta_bids.joints import Extension, Step

NAME = "joint"
EXTENSION = Extension(
    package=__name__,
    meaning="Test several measures, or both sides, together at each point.",
    steps=(
        Step(
            name=NAME,
            flag="--joint",
            names=("joint", "joint_sides"),
            options=f"{__name__}.options:add_options",
            settings=f"{__name__}.options:with_settings",
            permutes="joint.measures",
            condition=f"{__name__}.combine:is_asked",
            plan=f"{__name__}.combine:plan_joint",
            places={"surfaces": f"{__name__}.combine:combine_surfaces"},
            blocks={
                "methods-model": f"{__name__}.methods:methods",
                "files": f"{__name__}.output:joint_files",
            },
        ),
    ),
    settings=(("group", "joint", f"{__name__}.settings:JointSettings"),),
    findings=f"{__name__}.page:joint_finding",
)
