"""The files of a dataset as a whole: description, settings, methods text with references."""

import os
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urlsplit

from hipsta_bids import __version__
from hipsta_bids.derivatives.names import (
    DATASET_FILES,
    TEXTS,
    HemisphereName,
    ignore_file,
    output_path,
)
from hipsta_bids.errors import InputError, SettingsError, UsageError
from hipsta_bids.io import files
from hipsta_bids.io.files import DATASET, locked
from hipsta_bids.joints import find_groupings, find_texts, load
from hipsta_bids.protocols.protocol import Protocol, Tissue
from hipsta_bids.protocols.toml import flatten, resolve, settings_hash
from hipsta_bids.settings import BodySettings, Settings

NAME = "hipsta_bids"
BIDS_VERSION = "1.11.0"

#: Set in container images, read into ``GeneratedBy``: type, tag and address of the container.
CONTAINER_VARIABLES = {
    "Type": "HIPSTA_BIDS_CONTAINER_TYPE",
    "Tag": "HIPSTA_BIDS_CONTAINER_TAG",
    "URI": "HIPSTA_BIDS_CONTAINER_URI",
}

#: Set by Apptainer, which runs images of Docker too, and by Singularity before it.
_APPTAINER_VARIABLES = ("APPTAINER_CONTAINER", "SINGULARITY_CONTAINER")

#: Where the code is: set in container images; else it is read from the package's metadata.
CODE_URL_VARIABLE = "HIPSTA_BIDS_CODE_URL"
_CODE_LABELS = ("source", "repository")


def check_own_dataset(root: Path) -> None:
    """Refuse to write into a dataset that another program made."""
    path = root / DATASET_FILES["description"]
    if not path.exists():
        return
    makers = generated_by(files.read_json(path))
    if NAME not in makers:
        raise UsageError(
            f"{root}: already a dataset of {', '.join(makers) or 'another kind'}; choose an output"
            " folder of its own"
        )


def read_description(root: Path) -> dict[str, Any] | None:
    """Read ``dataset_description.json``: ``None`` if there is none, empty if it is unreadable."""
    path = root / DATASET_FILES["description"]
    try:
        return files.read_json(path)
    except InputError:
        return {} if path.exists() else None


def generated_by(description: Mapping[str, Any] | None) -> dict[str, str]:
    """Names and versions of the software that made a dataset, by its description."""
    entries = (description or {}).get("GeneratedBy")
    if not isinstance(entries, list):
        entries = [(description or {}).get("PipelineDescription")]  # BIDS before 1.4
    return {
        str(entry["Name"]): str(entry.get("Version") or "")
        for entry in entries
        if isinstance(entry, Mapping) and "Name" in entry
    }


def settle_settings(root: Path, settings: Settings) -> str:
    """Record the resolved settings, or check that the earlier runs here had the same ones.

    One folder holds results of one set of settings only: maps made with different ones must
    not be pooled, so this holds for every run, ``--force`` or not. Settings that an earlier
    version lacked may be added; with settings that this version lacks it is refused.
    """
    path = root / DATASET_FILES["settings"]
    digest, resolved = shared_settings(settings)
    if path.exists():
        earlier = files.read_json(path)
        is_same_version = earlier.get("version") == __version__
        if (earlier.get("hash"), is_same_version) == (digest, True):
            return digest
        before = earlier.get("settings")
        recorded = flatten(before if isinstance(before, dict) else {})
        current = flatten(resolved)
        if former := recorded.keys() - current.keys():
            raise SettingsError(
                f"{root}: results of version {earlier.get('version', 'unknown')}, which had "
                f"{len(former)} other settings ({min(former)}, ...); use a new output folder"
            )
        keys = current if is_same_version else recorded
        changes = [
            f"{key} was {recorded.get(key, 'not there')}, now {current.get(key, 'not there')}"
            for key in keys
            if recorded.get(key) != current.get(key)
        ]
        _refuse_other_grouping(root, recorded, current, changes)
        if changes or is_same_version or not recorded:
            raise SettingsError(
                f"{root}: results with other settings ({'; '.join(changes) or 'hash differs'}); "
                "use a new output folder, or delete this one"
            )
    content = {"hash": digest, "version": __version__, "settings": resolved}
    files.write_json(path, content)
    return digest


def _refuse_other_grouping(
    root: Path, recorded: Mapping[str, Any], current: Mapping[str, Any], changes: Sequence[str]
) -> None:
    """Refuse a folder in which other hemispheres were measured together; other changes follow."""
    for grouping in find_groupings():
        setting = grouping.setting
        advice = load(grouping.advice)(recorded.get(setting), current.get(setting))
        if advice:
            remainder = "; ".join(text for text in changes if not text.startswith(f"{setting} "))
            also = f" (other settings: {remainder})" if remainder else ""
            raise SettingsError(f"{root}: {advice}, or choose another output folder{also}")


def upgrade_notes(root: Path) -> list[str]:
    """Note that another version of the program has filled a folder; a run makes all of it again."""
    path = root / DATASET_FILES["settings"]
    earlier = files.read_json(path).get("version") if path.is_file() else None
    if earlier in {None, __version__}:
        return []
    consequence = f"{__version__} measures all hemispheres again, with the same settings only"
    return [f"{root}: results of version {earlier}; {consequence}"]


def shared_settings(settings: Settings) -> tuple[str, dict[str, Any]]:
    """Hash and resolve what all results of a folder share: everything but the region.

    The region is in the names of the files, so that one folder may hold several.
    """
    shared = settings.changed(body={"region": BodySettings().region})
    resolved = resolve(shared)
    del resolved["body"]["region"]
    return settings_hash(shared), resolved


def write_description(root: Path, sources: Mapping[str, Path]) -> None:
    """Write ``dataset_description.json``, and what :func:`write_notes` does.

    Sources of earlier runs into the same folder are kept.
    """
    path = root / DATASET_FILES["description"]
    earlier = files.read_json(path) if path.exists() else {}
    links = {name: link_to(folder, root) for name, folder in sources.items()}
    entries = [_source(folder, links[name]) for name, folder in sources.items()]
    current_folders = {str(folder.resolve()) for folder in sources.values()}
    before = earlier.get("SourceDatasets")
    before = [e for e in before if isinstance(e, dict)] if isinstance(before, list) else []
    retained = [e for e in before if not _is_at(e.get("URL"), root, current_folders)]
    description = {
        "Name": "Hippocampal thickness and curvature maps",
        "BIDSVersion": BIDS_VERSION,
        "DatasetType": "derivative",
        "GeneratedBy": [describe_maker()],
        "SourceDatasets": sorted(retained + entries, key=lambda entry: str(entry.get("URL"))),
        "DatasetLinks": dict(sorted(((read_links(root) if earlier else {}) | links).items())),
    }
    files.write_json(path, description)
    write_notes(root)


def write_notes(root: Path) -> None:
    """Write ``.bidsignore``, and a README unless the dataset has one."""
    files.write_text(root / DATASET_FILES["ignore"], ignore_file())
    if not any(root.glob("README*")):
        files.write_text(root / DATASET_FILES["readme"], TEXTS["readme"])


def describe_maker() -> dict[str, Any]:
    """Describe the program that made the dataset, an entry of ``GeneratedBy``."""
    maker: dict[str, Any] = {
        "Name": NAME,
        "Version": __version__,
        "Description": "Thickness, curvature and shape of the hippocampal body from subfields",
    }
    if url := _code_url():
        maker["CodeURL"] = url
    container = container_of_process()
    return maker | ({"Container": container} if container else {})


def container_of_process() -> dict[str, str]:
    """Return the container of this process: an entry of ``GeneratedBy``, empty outside."""
    container = {
        key: os.environ[variable]
        for key, variable in CONTAINER_VARIABLES.items()
        if os.environ.get(variable)
    }
    if any(os.environ.get(variable) for variable in _APPTAINER_VARIABLES):
        container["Type"] = "apptainer"
    return container


def _code_url() -> str | None:
    if url := os.environ.get(CODE_URL_VARIABLE):
        return url
    try:
        entries = metadata(NAME).get_all("Project-URL") or []
    except PackageNotFoundError:  # run from a folder, not installed
        return None
    pairs = (entry.partition(",") for entry in entries)
    urls = {label.strip().lower(): url.strip() for label, _, url in pairs}
    return next((urls[label] for label in _CODE_LABELS if label in urls), None)


def link_to(folder: Path, root: Path) -> str:
    """Write where a folder is, as seen from the dataset: a relative path, else a ``file:`` URI.

    The path is relative if it leads there and does not pass the root of the file system:
    in a container the folders there are mounted one by one. Otherwise the folder is spelled as
    the user did, symbolic links included. :func:`linked_folder` is the inverse.
    """
    spelled = Path(os.path.abspath(folder)), Path(os.path.abspath(root))  # noqa: PTH100  (no links followed)
    for source, target in (spelled, (folder.resolve(), root.resolve())):
        if Path(os.path.commonpath([source, target])) == Path(source.anchor):
            continue
        relative = os.path.relpath(source, target)
        if (root / relative).resolve() == folder.resolve():
            return quote(relative)
    return spelled[0].as_uri()


def linked_folder(link: str, root: Path) -> Path | None:
    """Find the folder that an entry of ``DatasetLinks`` leads to; ``None`` if it is remote."""
    parts = urlsplit(link)
    if not link or parts.scheme not in ("", "file"):
        return None
    return root / unquote(parts.path)  # an absolute path stays as it is


def read_links(root: Path) -> dict[str, str]:
    """Read ``DatasetLinks``: addresses of other datasets, by name."""
    links = files.read_json(root / DATASET_FILES["description"]).get("DatasetLinks")
    return {name: str(link) for name, link in links.items()} if isinstance(links, dict) else {}


def linked_path(address: str, root: Path, links: Mapping[str, str]) -> Path | None:
    """Find the file of a BIDS address, the inverse of :func:`source_address`."""
    if not address.startswith("bids:"):
        return Path(address) if address else None
    _, dataset, inside = address.split(":", 2)
    folder = linked_folder(links.get(dataset, ""), root)
    return folder / inside if folder is not None else None


def _is_at(url: object, root: Path, folders: Iterable[str]) -> bool:
    """Check whether an address leads to one of these folders, however it is written."""
    folder = linked_folder(str(url or ""), root)
    return folder is not None and str(folder.resolve()) in folders


def _source(folder: Path, link: str) -> dict[str, str]:
    """Describe where a source dataset is, with its identifier and version if these are known."""
    entry = {"URL": link}
    description = read_description(folder) or {}  # most FreeSurfer and ASHS folders have none
    for key, field in (("DOI", "DatasetDOI"), ("Version", "DatasetVersion")):
        if isinstance(description.get(field), str):
            entry[key] = description[field]
    return entry


def source_names(folders: Iterable[tuple[str, Path]]) -> dict[str, Path]:
    """Choose a unique name for each source dataset."""
    names: dict[str, Path] = {}
    for label, folder in dict.fromkeys(folders):
        base = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "-" for c in label)
        name, number = base, 2
        while names.get(name, folder) != folder:
            name, number = f"{base}-{number}", number + 1
        names[name] = folder
    return names


def source_address(path: Path, sources: Mapping[str, Path]) -> str:
    """Write the path of an input file as a BIDS address, ``bids:<dataset>:<path in it>``."""
    for name, folder in sources.items():
        if path.is_relative_to(folder):
            return f"bids:{name}:{path.relative_to(folder).as_posix()}"
    return str(path)


def references() -> dict[str, str]:
    """Read the entries of all works that methods rest on, by their keys."""
    path = resources.files("hipsta_bids.derivatives") / "references.toml"
    return tomllib.loads(path.read_text("utf-8"))


def _layer_rule(settings: BodySettings, protocols: Sequence[Protocol]) -> str:
    """Describe the molecular layer, and the protocols with which it was excluded."""
    texts: Mapping[str, str] = TEXTS["methods"]["layer"]
    separate = [p.name for p in protocols if Tissue.MOLECULAR_LAYER in p.interior and not p.layer]
    rule = texts[settings.layer_rule]
    if settings.join_every_layer or not separate:
        return rule
    return rule + texts["excluded"].format(names=", ".join(separate))


def numbered(text: str, works: Mapping[str, str]) -> tuple[str, list[str]]:
    """Return a text with its citations ``[@key]`` numbered in its order, and the works."""
    entries: list[str] = []

    def number(citation: re.Match[str]) -> str:
        entry = works[citation[1]]
        if entry not in entries:
            entries.append(entry)
        return f"[{entries.index(entry) + 1}]"

    return re.sub(r"\[@([\w-]+)\]", number, text), entries


def citation_text(
    settings: Settings,
    protocols: Sequence[Protocol],
    *,
    pybids: bool = False,
    probabilities: bool = False,
) -> str:
    """Compose the methods section, with all settings and the references.

    PyBIDS and probabilities of labels are in it only if they are used.
    """
    about, body, sheet = TEXTS["methods"], settings.body, settings.sheet
    titles = (
        "; ".join(f"{protocol.title} [@seg-{protocol.name}]" for protocol in protocols) or "none"
    )
    text = about["text"].format(
        version=__version__,
        titles=titles,
        pybids=about["pybids"] if pybids else "",
        probabilities=about["probabilities"] if probabilities else "",
        layer=_layer_rule(body, protocols),
        region=(about["region"] | find_texts("methods").get("region", {}))[body.region].format(
            faces=about["faces"]
        ),
        end_rule=about["end_rule"][body.end_rule],
        mending=about["mending"][body.mending],
        spacing=settings.grid.spacing,
        slices=settings.slices.min_ratio,
        smoothing=settings.grid.smoothing,
        least=settings.grid.min_smoothing,
        operator=about["operator"][settings.boundaries.operator],
        edges=about["edges"][settings.boundaries.edges],
        x_coordinate=about["x_coordinate"][sheet.x_coordinate],
        further="".join(
            load(g.methods)(settings) for g in find_groupings() if g.is_asked(settings)
        ),
        nodes=f"{sheet.x_nodes} x {sheet.y_nodes} x {sheet.z_nodes}",
        order=settings.measures.curvature_order,
        window=settings.measures.curvature_window,
    )
    works = references() | {f"seg-{protocol.name}": protocol.citation for protocol in protocols}
    text, entries = numbered(text, works)
    lines = [
        "# Methods",
        "",
        "This text may be used freely, as it stands or changed.",
        "",
        text,
        "",
        "# Settings",
        "",
        *(f"- `{key}`: {value}" for key, value in flatten(resolve(settings)).items()),
        "",
        "# References",
        "",
        *(f"{i}. {entry}" for i, entry in enumerate(entries, start=1)),
    ]
    return "\n".join(lines) + "\n"


# ``status.tsv``: one row per hemisphere, kept over all runs into the same folder.


Row = Mapping[str, str]
"""Cells by column."""

STAGE_PREFIX = "seconds_"

#: Columns of the tables of this dataset that are no measures, by table: definition and unit.
TABLES: dict[str, dict[str, list[str]]] = tomllib.loads(
    (resources.files("hipsta_bids.derivatives") / "columns.toml").read_text("utf-8")
) | find_texts("columns")
COLUMNS = TABLES["status"]

NOT_FINISHED = "not-finished"
"""Reason of a hemisphere that a run has not reached yet."""

KEY = ("subject", "session", "hemi", "seg")

#: Cells that the quality record has too.
RECORDED = ("decision", "reason", "version", "settings_hash", "input_hash")

_SHARD_TABLE = "status_shard-*.tsv"


def identity(name: HemisphereName) -> dict[str, str]:
    """Cells that identify the hemisphere of a row."""
    return {
        "subject": f"sub-{name.subject}",
        "session": f"ses-{name.session}" if name.session else files.MISSING,
        "hemi": name.hemi,
        "seg": name.seg,
        "region": name.region,
    }


def row_key(row: Row) -> tuple[str, ...]:
    """Cells that distinguish rows."""
    region = row.get("region", files.MISSING)
    # Rows of a table without that column are about the body.
    return *(row[key] for key in KEY), "body" if region == files.MISSING else region


def table_path(shard: str | None = None) -> str:
    """Path in the output dataset of the table, or of the table of one shard."""
    if shard is None:
        return DATASET_FILES["status"]
    return f"{DATASET_FILES['logs']}/{_SHARD_TABLE.replace('*', shard)}"


def read_status(root: Path) -> list[dict[str, str]]:
    """Read the rows of all runs so far, shards included.

    Of several rows of the same hemisphere, the one that agrees with the quality record is taken.
    """
    shards = sorted((root / DATASET_FILES["logs"]).glob(_SHARD_TABLE))
    rows_of: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for path in (root / DATASET_FILES["status"], *shards):
        for row in read_table(path):
            rows_of.setdefault(row_key(row), []).append(row)
    return [
        rows[0] if len(rows) == 1 else _current(root, rows) for _, rows in sorted(rows_of.items())
    ]


def read_table(path: Path, key: Sequence[str] = KEY) -> list[dict[str, str]]:
    """Read rows with all cells of a key; none if there is no table, or if it is unreadable."""
    try:
        rows = files.read_tsv(path)
    except InputError:
        return []
    return [row for row in rows if all(column in row for column in key)]


def _current(root: Path, rows: Sequence[dict[str, str]]) -> dict[str, str]:
    """Choose among rows of the same hemisphere."""
    try:
        record = files.read_json(root / output_path(name_of(rows[0]), "qc"))
    except InputError:
        record = {}

    def rank(row: Row) -> tuple[bool, bool, bool]:
        return (
            agrees(row, record),
            # If none agrees, one run has not finished.
            row.get("reason") == NOT_FINISHED,
            row.get("seconds", files.MISSING) != files.MISSING,
        )

    return max(rows, key=rank)


def agrees(row: Row, record: Mapping[str, Any]) -> bool:
    """Check whether a row agrees with a quality record."""
    return all(row.get(key) == (record.get(key) or files.MISSING) for key in RECORDED)


def name_of(row: Row) -> HemisphereName:
    """Identify whose row it is: the inverse of :func:`identity`."""
    *_, seg, region = row_key(row)
    session = row["session"].removeprefix("ses-")
    return HemisphereName(
        subject=row["subject"].removeprefix("sub-"),
        session=None if session == files.MISSING else session,
        hemi=row["hemi"],
        seg=seg,
        region=region,
    )


def update_status(root: Path, rows: Iterable[Row], *, shard: str | None = None) -> None:
    """Replace or add rows; rows of other hemispheres stay.

    Safe for several runs at a time into the same folder, as on a cluster.
    """
    path = root / table_path(shard)
    with locked(root, DATASET if shard is None else path.name):
        merged = {row_key(row): row for row in read_table(path)}
        merged |= {row_key(row): dict(row) for row in rows}
        ordered = [merged[key] for key in sorted(merged)]
        stages = dict.fromkeys(
            column for row in ordered for column in row if column.startswith(STAGE_PREFIX)
        )
        columns = (*COLUMNS, *stages)
        files.write_tsv(
            path,
            columns,
            ([row.get(column, files.MISSING) for column in columns] for row in ordered),
        )


def write_sidecar(root: Path) -> None:
    """Write ``status.json``, which defines the columns."""
    stages = {f"{STAGE_PREFIX}*": ["elapsed time of one stage, s"]}
    files.write_json(root / DATASET_FILES["status_sidecar"], describe_columns(COLUMNS | stages))


def describe_columns(columns: Mapping[str, Sequence[str]]) -> dict[str, dict[str, object]]:
    """Describe columns as sidecars do, by their definitions and units."""
    keys = ("Description", "Units")
    return {name: dict(zip(keys, about, strict=False)) for name, about in columns.items()}


#: Where the labels of a hemisphere come from: keys of ``provenance`` in its quality record.
PROVENANCE = tuple(TABLES["provenance"])


def counts_text(counts: Mapping[str, int]) -> str:
    """List names with their numbers of hemispheres."""
    return ", ".join(f"{name} ({n})" for name, n in sorted(counts.items()))


def provenance_of(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the origin of the labels of a quality record; ``n/a`` where it has none."""
    entry = record.get("provenance")
    fields = entry if isinstance(entry, Mapping) else {}
    return {key: str(fields.get(key) or files.MISSING) for key in PROVENANCE}


def write_inputs(root: Path, rows: Iterable[Row], *, is_whole: bool = True) -> None:
    """Write ``inputs.tsv``, which lists the results of a search.

    Rows of earlier searches stay if they are about other participants and this one was not about
    every participant.
    """
    path, table = root / DATASET_FILES["inputs"], TABLES["inputs"]
    columns = {"path": table["path"], **{name: COLUMNS[name] for name in KEY}, **table}
    columns |= TABLES["provenance"]
    listed = [{**dict.fromkeys(columns, files.MISSING), **row} for row in rows]
    with locked(root, DATASET):
        if not is_whole:
            subjects = {row["subject"] for row in listed}
            listed += [row for row in read_table(path) if row["subject"] not in subjects]
        listed.sort(key=lambda row: [row[key] for key in KEY])
        cells = ([row.get(name, files.MISSING) for name in columns] for row in listed)
        files.write_tsv(path, tuple(columns), cells)
        files.write_json(root / DATASET_FILES["inputs_sidecar"], describe_columns(columns))
