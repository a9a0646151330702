"""Results for other programs: surfaces, templates, and provenance as proposed for BIDS."""

from hipsta_bids.joints import Command, Extension

EXTENSION = Extension(
    package=__name__,
    meaning="Write surfaces, templates and provenance in formats of other programs.",
    commands=(
        Command(
            name="export",
            run=f"{__name__}.commands:run_export",
            parser=f"{__name__}.commands:export_parser",
            arguments="OUT_DIR DIR",
            meaning="write surfaces for FreeSurfer, or as VTK or PLY",
        ),
    ),
)
