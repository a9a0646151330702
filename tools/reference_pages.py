"""Pages of docs/ that are made from the code: outputs, settings, reasons, options."""

import argparse
import inspect
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping

from hipsta_bids.cli.commands import (
    meta_parser,
    phantom_parser,
    resample_parser,
    surrogate_parser,
)
from hipsta_bids.cli.group import group_parser
from hipsta_bids.cli.participant import build_parser
from hipsta_bids.derivatives.hemisphere import LAYERS, NODES, POSITION, STATE
from hipsta_bids.derivatives.names import (
    DATASET_FILES,
    EXTRA_OUTPUTS,
    IGNORED,
    OUTPUTS,
    SHARED,
    HemisphereName,
    Output,
    output_name,
)
from hipsta_bids.errors import EXIT_MEANINGS
from hipsta_bids.geometry.catalog import MAPS, PER_SUBFIELD, SECTIONS, SUMMARY, Column
from hipsta_bids.group.design.settings import GroupSettings
from hipsta_bids.group.output.tables import COLUMNS, JOINT_COLUMNS
from hipsta_bids.reports.page import read_table
from hipsta_bids.settings import Settings

NOTE = "<!-- Written by `tools/make-docs`; do not edit, run it again. -->"

OUTPUTS_TEXT = """\
A BIDS derivative dataset. Files of a hemisphere lie in `sub-X[/ses-Y]/anat/` and begin with
`sub-X[_ses-Y]_hemi-<L|R>`; `P` is the name of the segmentation protocol. Other regions than the
body have `label-extended` or `label-entorhinal` after `seg-P`. Missing values are `n/a` in tables
and NaN in GIFTI files. What the numbers mean, with figures: [Measures](measures.md).

Axes mean the same on both sides: x runs from medial (subiculum) to lateral (CA3), y from posterior
to anterior, z from interior to exterior. Head and tail are part of no number."""

SOURCES_TEXT = """\
`SourceDatasets` and `DatasetLinks` in `dataset_description.json` say where the segmentations are,
as a path relative to the output folder, so that both may move together. If the output moves alone,
pages made anew (`--reports-only`) draw no labels, and the group level needs `--segmentations DIR`,
until the participant level has run there or the links are corrected. Where the way there leads
through the root of the file system, the folder is written as you spelled it, `file:///...`. In a
container that is a path inside it, unless folders are mounted where they are outside: with
`-v /data:/data`, `/data/study` and `/data/study-hipsta` mean the same on both sides.

`GeneratedBy` has the version; in a container image also `Container`; and `CodeURL`, where the image
(`HIPSTA_BIDS_CODE_URL`) or the metadata of the package know it."""

IGNORED_TEXT = """\
The dataset passes the [BIDS validator](https://github.com/bids-standard/bids-validator) without
errors. BIDS 1.11 has no names for some of its files. They have entities in its order, and the
suffixes of the proposal for structural derivatives (BEP011) where it has one. `.bidsignore` lists
them, below; a sidecar has the ending of what it is about, so both are hidden by one line.

Each table has a JSON file beside it. Surfaces, maps, labels and masks follow the inheritance
principle: what is the same for all (`Description`, `Units`, `SpatialReference`) is said once, by
`thickness.json` and others in the root; `Sources`, which differ, by a file beside the images. No
image has two sidecars in a folder, so images share one if the name of one of them has no `desc`:
`curv.json` is about all curvatures and says by `desc` what differs, `interior.json` about the
surface in both spaces. `SpatialReference` is `orig`, the scanner RAS of the segmentation, in mm, or
in words. Units of maps are in the GIFTI files, too."""

COLUMNS_TEXT = """\
Which table has which is said in [Group level](group.md#what-is-written) and in the `.json` beside
each."""

SETTINGS_TEXT = """\
Every number that changes a result. `hipsta-bids settings` prints those of the participant level
as a TOML file, `hipsta-bids settings group` those of the group level. Change what you need, keep
the rest out, and give the file with `--settings`:"""

ONE_SET_TEXT = """\
One output folder holds results of one set of settings. Do not pool results of different settings.
Numbers that nobody has a reason to change are constants in the code, with their meaning."""

REASONS_TEXT = """\
Every reason has a short name that programs can read: in the column `reason` of `status.tsv`, in
`desc-qc_metrics.json`, and in the group level's `excluded.tsv`. The message beside it says where,
with the numbers. Here is what the names mean, in the order of what to do."""

OPTIONS_TEXT = """\
`hipsta-bids BIDS_DIR OUTPUT_DIR participant` measures, `... group` compares. Other commands:
`demo`, `phantom`, `surrogate`, `meta`, `resample`, `settings`, `protocols`. All print
these texts with `--help`. Options accept underscores instead of hyphens (`--n_procs`)."""

_SHARED_TEXT = "of all images with these endings: what they are, unit, space"

_DATASET_FILES = {
    "description": "what BIDS asks for, with versions and sources",
    "readme": "what is where; written unless there is a README",
    "ignore": "which files are [not in the standard](#names-that-bids-does-not-have)",
    "settings": "all settings of these results, and their hash",
    "citation": "a methods paragraph with references, for your article",
    "status": "one row per hemisphere: decision, reason, message, time per stage, peak memory",
    "status_sidecar": "its columns",
    "measures": "one row per hemisphere: decision, rating, origin, all summary measures",
    "measures_sidecar": "its columns, with units",
    "ratings": "[ratings](running.md#review), if you save them there",
    "inputs": "each hemisphere, file and folder of the inputs: used or not, and why",
    "inputs_sidecar": "its columns",
    "logs": "one file per run",
    "group": "results of the [group level](group.md#what-is-written), one folder per model",
    "report": "all hemispheres; beside it a page per participant and session",
}


def outputs_page() -> str:
    """Write the page of files and columns."""
    place, state, layers = (
        [(name, about[1] if about[1:] else None, about[0]) for name, about in columns.items()]
        for columns in (NODES | POSITION, STATE, LAYERS)
    )
    columns = ("column", "unit", "what it is")
    parts = [
        "# Outputs",
        OUTPUTS_TEXT,
        "## Files of a hemisphere",
        _table(("file", "content"), _files(OUTPUTS)),
        "With an option or another command:",
        _table(("file", "content"), _files(EXTRA_OUTPUTS)),
        "## Files of the dataset",
        _table(
            ("file", "content"),
            (
                *((f"`{name}`", _DATASET_FILES[key]) for key, name in DATASET_FILES.items()),
                (", ".join(f"`{row.for_all}`" for row in SHARED), _SHARED_TEXT),
            ),
        ),
        "## Sources",
        SOURCES_TEXT,
        "## Names that BIDS does not have",
        IGNORED_TEXT,
        _table(
            ("files", "why"),
            ((f"`{pattern.lstrip('/')}`", why) for pattern, why in IGNORED.items()),
        ),
        "## Columns of `desc-sheet_morph.tsv`",
        "One row per point of the sheet.",
        _table(columns, _named([*place, *_measures(MAPS), *state])),
        "## Columns of `desc-sections_morph.tsv`",
        "One row per cross-section, `y` from the posterior to the anterior end.",
        _table(columns, _named(_measures(SECTIONS))),
        "## Columns of `desc-summary_morph.tsv`",
        "One row per hemisphere.",
        _table(columns, _named(_measures(SUMMARY))),
        "And per subfield:",
        _table(columns, _named(_measures(PER_SUBFIELD, ending="_NAME"))),
        "## Columns of `desc-profile_morph.tsv`",
        "`axis`, `node`, and the maps of the sheet table, averaged over the other axis by area.",
        "## Columns of `desc-layers_morph.tsv`",
        "One row per point of the three-dimensional grid (`--write-meshes`).",
        _table(columns, _named(layers)),
        "## Columns of the group level's tables",
        COLUMNS_TEXT,
        _table(
            ("column", "what it is"),
            ((f"`{k}`", v) for k, v in {**COLUMNS, **JOINT_COLUMNS, **COLUMNS}.items()),
        ),
    ]
    return _page(parts)


def _files(outputs: Iterable[Output]) -> Iterator[tuple[str, str]]:
    name = HemisphereName(subject="X", session=None, hemi="L", seg="P")
    for output in outputs:
        desc = "NAME" if output.desc == "*" else None
        spelled = output_name(name, output.key, desc).removeprefix(name.stem)
        yield f"`{spelled}`", output.description


def _measures(rows: Iterable[Column], ending: str = "") -> list[tuple[str, str, str]]:
    words = "the subfield"
    return [(f"{x.name}{ending}", x.unit, x.definition.format(words)) for x in rows]


def _named(rows: Iterable[tuple[str, str | None, str]]) -> Iterator[tuple[str, str, str]]:
    return ((f"`{name}`", unit or "", words) for name, unit, words in rows)


def settings_page() -> str:
    """Write the page of settings of both levels."""
    parts = [
        "# Settings",
        SETTINGS_TEXT,
        '```toml\n[sheet]\nx_nodes = 61\n\n[body]\nlayer_rule = "nearest-label"\n```',
        ONE_SET_TEXT,
        "## Participant level",
        _table(("setting", "default", "meaning"), _stages(Settings())),
        "## Group level",
        _table(("setting", "default", "meaning"), _stages(GroupSettings())),
    ]
    return _page(parts)


def _stages(settings: Settings | GroupSettings) -> Iterator[tuple[str, str, str]]:
    for name, stage in settings:
        yield f"**{name}**", "", f"**{_words(inspect.getdoc(type(stage)))}**"
        for key, field in type(stage).model_fields.items():
            value = json.dumps(getattr(stage, key))
            yield f"`{name}.{key}`", f"`{value}`", _words(field.description)


def _words(text: str | None) -> str:
    return " ".join((text or "").split()).replace("``", "`")


def reasons_page() -> str:
    """Write the page of flags, refusals and what to do about them."""
    table = read_table("reasons.toml")
    sections = table["section"]
    where = ((section["title"], " ".join(section["text"].split())) for section in sections)
    parts = [
        "# Flags and refusals",
        REASONS_TEXT,
        _table(("where a reason is given", "what it says"), where),
    ]
    for action, title in table["actions"].items():
        parts.append(f"## {title}")
        for section in sections:
            rows = section["reasons"].items()
            reasons = {name: row for name, row in rows if row["action"] == action}
            parts += [f"**{section['title']}**"] if reasons else []
            # A heading for each, so that it can be searched for and linked to.
            for name, row in sorted(reasons.items()):
                parts += [f"#### `{name}`", f"{row['meaning']}\n**Try:** {row['remedy']}"]
    codes = ((str(int(code)), words) for code, words in EXIT_MEANINGS.items())
    return _page([*parts, "## Exit codes", _table(("code", "meaning"), codes)])


def options_page() -> str:
    """Write the page of all options of all commands."""
    parts = [
        "# Command line",
        OPTIONS_TEXT,
    ]
    for title, parser in (
        ("Participant level", build_parser()),
        ("Group level", group_parser()),
        ("hipsta-bids phantom", phantom_parser()),
        ("hipsta-bids surrogate", surrogate_parser()),
        ("hipsta-bids meta", meta_parser()),
        ("hipsta-bids resample", resample_parser()),
    ):
        parts.append(f"## {title}")
        for group in parser._action_groups:  # noqa: SLF001  (argparse shows nothing in public)
            rows = [_option(a) for a in group._group_actions if a.help != argparse.SUPPRESS]  # noqa: SLF001
            if rows:
                parts += [
                    f"**{str(group.title).capitalize()}**",
                    _table(("option", "meaning"), rows),
                ]
    return _page(parts)


def _option(action: argparse.Action) -> tuple[str, str]:
    spellings = action.option_strings or [str(action.metavar or action.dest.upper())]
    names = [name for name in spellings if name[0] != "-" or "_" not in name]
    values = (action.metavar or action.dest.upper()) if action.option_strings else ""
    if action.choices is not None and action.metavar is None:
        values = "{" + ",".join(map(str, action.choices)) + "}"
    text = values if isinstance(values, str) else " ".join(values)
    shown = f" {text}" if text and action.nargs != 0 else ""
    return ", ".join(f"`{name}{shown}`" for name in names), _escape(
        (action.help or "") % vars(action)
    )


def _escape(text: str) -> str:
    """Keep stars, braces and angle brackets as they are written."""
    return re.sub(r"([*_<>\[\]])", r"\\\1", " ".join(text.split()))


def _table(headings: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [headings, ("---",) * len(headings), *rows]
    return "\n".join(f"| {' | '.join(x.replace('|', '&#124;') for x in line)} |" for line in lines)


def _page(parts: Iterable[str]) -> str:
    return "\n\n".join([NOTE, *(part for part in parts if part)]) + "\n"


#: Every page, by its file below docs/.
PAGES: Mapping[str, Callable[[], str]] = {
    "outputs.md": outputs_page,
    "settings.md": settings_page,
    "reasons.md": reasons_page,
    "command-line.md": options_page,
}
