"""Several sites together, without values of participants: summaries, meta-analyses, norms."""

from hipsta_bids.joints import Command, Extension, Part

EXTENSION = Extension(
    package=__name__,
    meaning="Combine results and norms of several sites, without values of participants.",
    commands=(
        Command(
            name="meta",
            run=f"{__name__}.commands:run_meta_analysis",
            parser=f"{__name__}.commands:meta_parser",
            arguments="SITE... OUT",
            meaning="combine summaries of sites (group level)",
        ),
    ),
    settings=(
        ("group", "exchange", "hipsta_bids.stats.settings:ExchangeSettings"),
        ("group", "meta", f"{__name__}.settings:MetaSettings"),
    ),
    parts=(
        Part(
            option="--export-summary",
            value="SITE",
            text="also write summary.json for `hipsta-bids meta`, without values of participants; "
            "SITE: this site's name (default: BIDS_DIR's)",
            heading="other sites",
            make=f"{__name__}.exchange:prepare_summary",
        ),
    ),
)
