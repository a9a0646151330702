"""Pages of docs/ that are made from the code: outputs, settings, reasons, options."""

import argparse
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from hipsta_bids.cli.commands import (
    figure_parser,
    phantom_parser,
)
from hipsta_bids.cli.group import group_parser
from hipsta_bids.cli.participant import build_parser
from hipsta_bids.derivatives.names import (
    DATASET_FILES,
    EXTRA_OUTPUTS,
    OUTPUTS,
    SHARED,
    HemisphereName,
    Output,
    output_name,
)
from hipsta_bids.derivatives.results import LAYERS, NODES, POSITION, STATE
from hipsta_bids.errors import EXIT_MEANINGS
from hipsta_bids.geometry.catalog import MAPS, PER_SUBFIELD, SECTIONS, SUMMARY, Column
from hipsta_bids.group.output.tables import COLUMNS, read_columns
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.joints import find_extensions, is_present, load
from hipsta_bids.protocols.toml import read_meanings
from hipsta_bids.reports.page import read_table
from hipsta_bids.settings import Settings

NOTE = "<!-- Written by `tools/make-docs`; do not edit, run it again. -->"

OUTPUTS_TEXT = """\
The output folder is a BIDS derivative dataset. Files of a hemisphere lie in `sub-X[/ses-Y]/anat/`
and begin with `sub-X[_ses-Y]_hemi-<L|R>`. `P` is the segmentation protocol. Regions other than the
body have `label-NAME` after `seg-P`. Missing values are `n/a` in tables and NaN in GIFTI files.

The axes have the same meaning in both hemispheres. Axis x runs from the medial to the lateral edge,
and y from the posterior to the anterior end plane. Axis z runs from the interior to the exterior
wall. Head and tail are excluded from all numbers of the body. [Measures](measures.md) defines the
measures."""

SIDECARS_TEXT = """\
Each table has a JSON file with the columns and units. Each image has a JSON file with its inputs
(`Sources`); images with the same suffix may share the file. With an option or another command:"""

SOURCES_TEXT = """\
`dataset_description.json` names the folders of the segmentations (`SourceDatasets`,
`DatasetLinks`), relative to the output folder. Move both folders together. If only the output
moves, `--reports-only` draws no labels, and the group level needs `--segmentations DIR`. Folders
that are reached through the root of the file system have absolute paths. In a container, mount
folders at the path that they have outside (`-v /data:/data`).

`GeneratedBy` has the version, and in a container image `Container` and `CodeURL`."""

IGNORED_TEXT = """\
The dataset passes the [BIDS validator](https://github.com/bids-standard/bids-validator) without
errors. BIDS 1.11 has no names for some files. `.bidsignore` lists 8 patterns, with the
reason and the files that each pattern hides. The validator checks the others: 4 files of the
dataset, and the subfields on each surface with their sidecar. The entities of all files follow the
order of BIDS, and their suffixes the proposal for structural derivatives (BEP011).

Properties of all images with one suffix (`Description`, `Units`, `SpatialReference`) are in the
root, for example in `thickness.json`. `SpatialReference` is `orig` for the scanner RAS space of the
segmentation, in mm."""

GROUP_FILES = (Path(__file__).parent / "group_files.md").read_text("utf-8").strip()

NODES_TEXT = """\
In all tables of hemispheres, and in tables for `--roi` and `--mask`, `x` and `y` are numbers of
nodes. At the group level these are `node_x` and `node_y`; `x` and `y` are coordinates there."""

TABLES_TEXT = """\
`desc-sections_morph.tsv` has one row per cross-section from posterior to anterior, with the number
`y` of the section, and {sections}.

`desc-summary_morph.tsv` has one row, with {summary}, and per subfield {subfields}.

`desc-profile_morph.tsv` has one row per `axis` and `node`, with each map of the sheet table
averaged over the other axis, weighted by area.

`desc-layers_morph.tsv` (`--write-meshes`) has one row per point of the three-dimensional grid:"""

COLUMNS_TEXT = """\
The JSON file beside each table describes its columns. `_low` and `_high` end the names of
confidence limits, `_se` of standard errors, `_cv_sd` of SDs over repeats. `pN` is centile N at the
average site, `below_N` the cross-validated share below centile N (5, 25, 50, 75, 95)."""

SETTINGS_TEXT = """\
Settings change results. `hipsta-bids settings` prints the settings of the participant level as a
TOML file, `hipsta-bids settings group` the settings of the group level. Keep the lines that you
change, and give the file with `--settings`:"""

ONE_SET_TEXT = """\
An output folder holds results of one set of settings. Do not pool results of different settings.
Below are the settings that users change; [All settings](settings-all.md) has the others. Many of
them have an option on the [command line](command-line.md)."""

REST_TEXT = """\
Limits, sizes and iterations, beside the [settings that users change](settings.md). The defaults are
the values of the [validation](validation.md)."""

_CHANGED = {
    "body": "region layer_rule join_every_layer end_rule end_margin mending",
    "boundaries": "operator edges",
    "sheet": "x_nodes y_nodes z_nodes x_coordinate depths",
    "uncertainty": "relabeling end_shift",
    "maps": "min_known",
    "surrogate": "positions",
    "registration": "align standardize",
    "model": "group_columns covariates age icv_columns",
    "design": "factors mixed",
    "glm": "covariance",
    "longitudinal": "random",
    "harmonization": "column",
    "asymmetry": "relative",
    "multiplicity": "method scope alpha permutations blocks",
    "joint": "measures",
    "classification": "base added",
    "norms": "shared_knots",
    "meta": "random",
}
_TABLES = {*Settings.model_fields, *GroupSettings.model_fields}
#: Settings that users change, of the participant and of the group level, as far as these exist.
CHANGED: Mapping[str, str] = {n: names for n, names in _CHANGED.items() if n in _TABLES}

REASONS_TEXT = """\
A reason is a short name for programs. It is in the column `reason` of `status.tsv` and
`measures.tsv`, in `desc-qc_metrics.json`, and in `excluded.tsv` of the group level. The message
beside it gives place and numbers. This page lists the reasons by the action that they need."""

OPTIONS_TEXT = """\
`hipsta-bids BIDS_DIR OUTPUT_DIR participant` measures; `hipsta-bids BIDS_DIR OUTPUT_DIR group`
analyzes. The commands `demo`, `demo-data`, `phantom`, `surrogate`, `meta`, `compare`, `replicate`,
`correlate`, `resample`, `settings` and `protocols` print their options with `--help`. For both
levels `--help` prints the options that a first run needs, and `--help all` all options.
`--version` prints the version. Options accept underscores instead of hyphens (`--n_procs`)."""

_SHARED_TEXT = "properties of all images with these suffixes"

_DATASET_FILES = {
    "description": "description of the dataset, with versions and sources",
    "readme": "overview; an existing README is kept",
    "ignore": "files that are [not in the standard](#bids)",
    "settings": "all settings, and their hash",
    "citation": "methods paragraph with references",
    "status": "one row per hemisphere: decision, reason, message, time per stage, peak memory",
    "measures": "one row per hemisphere: decision, rating, origin of the labels, summary measures",
    "ratings": "ratings that were saved from the pages",
    "inputs": "each hemisphere, file and folder of the inputs: used or not, and the reason",
    "logs": "one file per run",
    "group": "results of the [group level](group.md), one folder per model",
    "report": "page of all hemispheres; each participant and session has a page beside it",
}


def outputs_page() -> str:
    """Write the page of files and columns."""
    place, state, layers = (
        [(name, about[1] if about[1:] else "", about[0]) for name, about in columns.items()]
        for columns in (NODES | POSITION, STATE, LAYERS)
    )
    columns = ("column", "unit", "meaning")
    parts = [
        "# Outputs",
        OUTPUTS_TEXT,
        "## Files of a hemisphere",
        table(("file", "content"), _files(OUTPUTS)),
        SIDECARS_TEXT,
        table(("file", "content"), _files(EXTRA_OUTPUTS)),
        "## Files of the dataset",
        table(
            ("file", "content"),
            (
                *((f"`{DATASET_FILES[key]}`", text) for key, text in _DATASET_FILES.items()),
                (", ".join(f"`{row.for_all}`" for row in SHARED), _SHARED_TEXT),
            ),
        ),
        "## Sources",
        SOURCES_TEXT,
        "## BIDS",
        IGNORED_TEXT,
        "## Columns of `desc-sheet_morph.tsv`",
        f"One row per grid point, with the measures {_measures(MAPS)}, and:",
        table(columns, _named([*place, *state])),
        NODES_TEXT,
        "## Columns of the other tables",
        TABLES_TEXT.format(
            sections=_measures(SECTIONS),
            summary=_measures(SUMMARY),
            subfields=_measures(PER_SUBFIELD, ending="_NAME"),
        ),
        table(columns, _named(row for row in layers if row not in place)),
        GROUP_FILES,
        "## Columns of the group level",
        COLUMNS_TEXT,
        table(("column", "meaning"), _group_columns()),
    ]
    return _page(parts)


def _files(outputs: Iterable[Output]) -> Iterator[tuple[str, str]]:
    """Name the files but for sidecars; maps by their measure."""
    name = HemisphereName(subject="X", session=None, hemi="L", seg="P")
    measures = {row.name: f"map of `{row.name}`, {row.unit}" for row in MAPS}
    for output in outputs:
        if output.extension == ".json" and output.key != "qc":
            continue
        desc = "NAME" if output.desc == "*" else None
        spelled = output_name(name, output.key, desc).removeprefix(name.stem)
        yield f"`{spelled}`", measures.get(output.key, output.description)


def _measures(rows: Iterable[Column], ending: str = "") -> str:
    """List names of measures, with their units."""
    units = {"1": ""}
    named = ((f"`{x.name}{ending}`", units.get(x.unit, f" ({x.unit})")) for x in rows)
    return ", ".join(f"{name}{unit}" for name, unit in named)


def _named(rows: Iterable[tuple[str, str, str]]) -> Iterator[tuple[str, str, str]]:
    return ((f"`{name}`", unit, words) for name, unit, words in rows)


def _group_columns() -> Iterator[tuple[str, str]]:
    """Explain the columns of the group level whose names do not follow a rule of the page."""
    ruled = re.compile(r".+_(low|high|se|cv_sd)|(p|below_)\d+")
    columns = dict(COLUMNS)
    for extension in find_extensions():
        if extension.has("columns.toml"):
            columns = {**read_columns(extension.package), **columns}
    columns = {name: words for name, words in columns.items() if isinstance(words, str)}
    for name, words in columns.items():
        if not ruled.fullmatch(name) and words not in {name, name.removesuffix("_id")}:
            yield f"`{name}`", words


def settings_page() -> str:
    """Write the page of the settings that users change."""
    parts = [
        "# Settings",
        SETTINGS_TEXT,
        '```toml\n[sheet]\nx_nodes = 61\n\n[body]\nlayer_rule = "nearest-label"\n```',
        ONE_SET_TEXT,
        *_levels(lambda stage, name: name in CHANGED.get(stage, "").split()),
    ]
    return _page(parts)


def all_settings_page() -> str:
    """Write the page of the other settings."""
    parts = [
        "# All settings",
        REST_TEXT,
        *_levels(lambda stage, name: name not in CHANGED.get(stage, "").split()),
    ]
    return _page(parts)


def _levels(listed: Callable[[str, str], bool]) -> Iterator[str]:
    """Write a section per level with the settings that are listed."""
    for title, settings in (("Participant", Settings()), ("Group", GroupSettings())):
        yield f"## {title} level"
        yield table(("setting", "default", "meaning"), _settings(settings, listed))


def _settings(
    settings: Settings | GroupSettings, listed: Callable[[str, str], bool]
) -> Iterator[tuple[str, str, str]]:
    """Name settings with default and meaning; settings with the same texts share a row."""
    names: dict[tuple[str, str], list[str]] = {}
    for stage, values in settings:
        meanings = read_meanings(type(values))
        for name in type(values).model_fields:
            if listed(stage, name):
                texts = json.dumps(getattr(values, name)), _words(meanings[name])
                names.setdefault(texts, []).append(f"`{stage}.{name}`")
    return ((", ".join(rows), f"`{value}`", words) for (value, words), rows in names.items())


def _words(text: str | None) -> str:
    return " ".join((text or "").split()).replace("``", "`")


def reasons_page() -> str:
    """Write the page of flags, refusals and what to do about them."""
    reasons_table = read_table("reasons.toml")
    sections = reasons_table["section"]
    where = [f"- **{section['title']}**: {_words(section['text'])}" for section in sections]
    parts = ["# Flags and refusals", REASONS_TEXT, "\n".join(where)]
    for action, title in reasons_table["actions"].items():
        parts.append(f"## {title}")
        for section in sections:
            rows = section["reasons"].items()
            reasons = {name: row for name, row in rows if row["action"] == action}
            parts += [f"**{section['title']}**"] if reasons else []
            # A heading for each, so that it can be searched for and linked to.
            for name, row in sorted(reasons.items()):
                parts += [f"#### `{name}`", f"{_words(row['meaning'])} *{_words(row['remedy'])}*"]
    return _page(parts)


def options_page() -> str:
    """Write the page of all options of all commands."""
    parts = ["# Command line", OPTIONS_TEXT]
    described: dict[tuple[str, str], str] = {}
    for title, parser in (
        ("Participant level", build_parser()),
        ("Group level", group_parser()),
        ("hipsta-bids phantom", phantom_parser()),
        ("hipsta-bids figure", figure_parser()),
        *(
            (f"hipsta-bids {command.name}", load(command.parser)())
            for extension in find_extensions()
            for command in extension.commands
            if command.parser
        ),
    ):
        parts.append(f"## {title}")
        groups = {
            str(group.title).capitalize(): [
                _option(a)
                for a in group._group_actions  # noqa: SLF001  (argparse shows nothing in public)
                if a.help != argparse.SUPPRESS and a.dest not in {"help", "version"}
            ]
            for group in parser._action_groups  # noqa: SLF001
        }
        repeated: dict[str, list[str]] = {}
        for name, rows in groups.items():
            new = [row for row in rows if described.setdefault(row, title) == title]
            parts += [f"**{name}**", table(("option", "meaning"), new)] if new else []
            for row in rows:
                repeated.setdefault(described[row], []).append(row[0].split(", ")[0])
        repeated.pop(title, None)
        parts += [f"As under {where}: {', '.join(rows)}." for where, rows in repeated.items()]
    codes = ((str(int(code)), words) for code, words in EXIT_MEANINGS.items())
    return _page([*parts, "## Exit codes", table(("code", "meaning"), codes)])


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


def table(headings: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Write a table in Markdown."""
    lines = [headings, ("---",) * len(headings), *rows]
    return "\n".join(f"|{' |'.join(x.replace('|', '&#124;') for x in line)}|" for line in lines)


def _page(parts: Iterable[str]) -> str:
    return "\n\n".join([NOTE, *(part for part in parts if part)]) + "\n"


def published_table() -> str:
    """Return the published numbers."""
    from hipsta_bids.extensions.agreement.replicate import PUBLISHED  # noqa: PLC0415  (may be absent)

    return PUBLISHED.read_text("utf-8")


def replicate_sidecar() -> str:
    """Describe the columns of the published numbers, and of own numbers beside them."""
    from hipsta_bids.extensions.agreement.columns import (  # noqa: PLC0415  (may be absent)
        REPLICATE_COLUMNS,
    )

    columns = {name: {"Description": text} for name, text in REPLICATE_COLUMNS.items()}
    return json.dumps(columns, indent=2) + "\n"


#: Every page, by its file below docs/.
PAGES: Mapping[str, Callable[[], str]] = {
    "outputs.md": outputs_page,
    "settings.md": settings_page,
    "settings-all.md": all_settings_page,
    "reasons.md": reasons_page,
    "command-line.md": options_page,
} | (
    {"replicate.tsv": published_table, "replicate.json": replicate_sidecar}
    if is_present("agreement")
    else {}
)
