"""Repeated sessions: changes between two, mixed models of all, and end points of trials."""

from hipsta_bids.joints import Extension, SessionChoice

EXTENSION = Extension(
    package=__name__,
    meaning="Compare several sessions of a participant, and end points of trials.",
    sessions=(
        SessionChoice(
            names=("longitudinal", "endpoint", "paired"),
            hint="--longitudinal takes all, --paired two",
            options=f"{__name__}.options:add_options",
            settings=f"{__name__}.options:given_settings",
            make=f"{__name__}.options:choose_sessions",
            page=f"{__name__}.page:describe_rows",
        ),
    ),
)
