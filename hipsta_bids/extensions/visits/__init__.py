"""Visits of a participant on one sheet, of their mean labels."""

from hipsta_bids.joints import Extension, Grouping

EXTENSION = Extension(
    package=__name__,
    meaning="Measure all visits of a participant on one sheet.",
    groupings=(
        Grouping(
            setting="sheet.frame",
            commands={"person": ("--longitudinal",), "shared": ("--longitudinal", "shared")},
            options=f"{__name__}.options:add_options",
            settings=f"{__name__}.settings:apply",
            advice=f"{__name__}.settings:advise",
            notes=f"{__name__}.jobs:note_sheets",
            gather=f"{__name__}.jobs:share_sheets",
            run=f"{__name__}.jobs:run_visits",
            is_complete=f"{__name__}.files:has_change",
            methods=f"{__name__}.settings:write_sentences",
            columns=f"{__name__}.page:read_change",
        ),
    ),
    settings=(("participant", "sheet", f"{__name__}.settings:FrameSettings"),),
    participant_sections=f"{__name__}.page:SECTIONS",
)
"""The option ``--longitudinal`` of the participant level."""
