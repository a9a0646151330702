"""The table of outputs, the names and paths of results, and what sidecars say of images.

Entities follow the order of BIDS 1.11 (``sub ses hemi space seg label desc``). What the standard
has no rule for is listed in ``.bidsignore``, with the reason, from the table next to it.
"""

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from fnmatch import fnmatchcase
from importlib.resources import files as files_of
from pathlib import Path, PurePosixPath
from typing import Any

from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.io import files
from hipsta_bids.joints import find_texts
from hipsta_bids.protocols import EXPERIMENTAL
from hipsta_bids.types import Hemisphere

#: What files are, and what those of the dataset as a whole say.
TEXTS = tomllib.loads((files_of("hipsta_bids.derivatives") / "texts.toml").read_text("utf-8"))
_FURTHER = find_texts("outputs")
_ABOUT = TEXTS["outputs"] | {key: row["text"] for key, row in _FURTHER.items()}


@dataclass(frozen=True, kw_only=True, slots=True)
class HemisphereName(Hemisphere):
    """The BIDS identity of one result."""

    seg: str
    """Name of the segmentation protocol."""
    region: str = "body"
    """What was measured; other regions than the body are in the names, as ``label-``."""

    @property
    def protocol(self) -> str:
        """Entities that distinguish results of one hemisphere: protocol and region."""
        label = "" if self.region == "body" else f"_label-{self.region}"
        return f"seg-{self.seg}{label}"

    @property
    def region_title(self) -> str:
        """The region in words; empty for the body."""
        trial = " (experimental)" if self.region in EXPERIMENTAL else ""
        return "" if self.region == "body" else f"{self.region} region{trial}"

    @property
    def pattern(self) -> str:
        """Glob pattern of its file names, in which no other region has a part."""
        # No suffix of the table begins as the entity label does.
        return f"{self.stem}_*{self.protocol}_{'[!l]*' if self.region == 'body' else '*'}"

    @property
    def stem(self) -> str:
        """Subject, session and side, with which all file names begin."""
        session = f"_ses-{self.session}" if self.session else ""
        return f"sub-{self.subject}{session}_hemi-{self.hemi}"

    @property
    def title(self) -> str:
        """Name in messages, logs and pages."""
        return f"{self.stem}_{self.protocol}"

    @property
    def folder(self) -> PurePosixPath:
        """Folder of the results, relative to the output dataset."""
        session = [f"ses-{self.session}"] if self.session else []
        return PurePosixPath(f"sub-{self.subject}", *session, "anat")


@dataclass(frozen=True)
class Output:
    """One row of the output table."""

    key: str
    suffix: str
    extension: str
    description: str
    _: KW_ONLY
    unit: str | None = None
    """Unit of the numbers of an image."""
    desc: str | None = None
    space: str | None = None
    optional: bool = False
    """Written on request only."""
    in_standard: bool = False
    """Whether BIDS 1.11 has a rule for this name."""
    images: "tuple[Output, ...]" = ()
    """Images that a sidecar is about."""

    @property
    def for_all(self) -> str:
        """Name in the root of the dataset of a sidecar about these images of every hemisphere."""
        return f"desc-{self.desc}_{self.suffix}.json" if self.desc else f"{self.suffix}.json"


def _output(key: str, suffix: str, extension: str, **options: Any) -> Output:  # noqa: ANN401  (fields)
    """Describe a file by its text."""
    return Output(key, suffix, extension, _ABOUT[key], **options)


def _table(
    key: str, *, called: str | None = None, note: str = "", optional: bool = False
) -> tuple[Output, Output]:
    """Describe a table of one hemisphere, and its sidecar."""
    text = _ABOUT[key] + note
    sidecar = f"columns, units and definitions of {called or f'the {key} table'}{note}"
    return (
        Output(key, "morph", ".tsv", text, desc=key, optional=optional),
        Output(f"{key}_sidecar", "morph", ".json", sidecar, desc=key, optional=optional),
    )


def _sidecars(images: Sequence[Output]) -> tuple[Output, ...]:
    """Describe the sidecars of images.

    By BIDS' inheritance, one without ``desc`` is also about files with ``desc`` or ``space``, and
    no file may have two in a folder. So where an image of some suffix has no ``desc``, all images
    with that suffix share a sidecar.
    """
    shared = {row.suffix for row in images if row.desc is None}
    groups: dict[tuple[str, str | None], list[Output]] = {}
    for row in images:
        groups.setdefault((row.suffix, None if row.suffix in shared else row.desc), []).append(row)
    return tuple(
        Output(
            f"{desc or suffix}_sources",
            suffix,
            ".json",
            "sources of the images with this ending (`Sources`)",
            desc=desc,
            in_standard=rows[0].in_standard,
            images=tuple(rows),
        )
        for (suffix, desc), rows in groups.items()
    )


_MESHES = " (`--write-meshes`)"

_IMAGES = (
    *(
        Output(
            f"{name}_{kind}", name, ".surf.gii", f"{name} {_ABOUT[kind]}", unit="mm", space=space
        )
        for kind, space in (("surface", None), ("unfold", "unfold"))
        for name in ("interior", "midthickness", "exterior")
    ),
    *(
        Output(
            row.name,
            row.suffix,
            ".shape.gii",
            f"{row.definition}; per surface vertex, {row.unit}",
            unit=row.unit,
            desc=row.desc,
        )
        for row in MAPS
    ),
    _output("subfields", "dseg", ".label.gii", in_standard=True),
    _output("body_mask", "mask", ".nii.gz", desc="body"),
)

#: Every file of one hemisphere. The quality record comes last: it is written when all else is
#: there, so that its presence means that the set is complete.
OUTPUTS: tuple[Output, ...] = (
    *_table("sheet"),
    *_table("summary"),
    *_table("profile"),
    *_table("sections"),
    *_IMAGES,
    *_sidecars(_IMAGES),
    *_table("layers", note=_MESHES, optional=True),
    _output("mesh", "mesh", ".vtu", desc="tet", optional=True),
    _output("qc", "metrics", ".json", desc="qc"),
)


def _of_extensions() -> Iterator[Output]:
    """Describe files that extensions add: tables, records, and images with their sidecars.

    Those with names that the user gives are described alone.
    """
    images = []
    for key, row in _FURTHER.items():
        fields = {name: value for name, value in row.items() if name != "text"}
        if not fields:
            yield from _table(key, called="that table")
        elif fields["extension"] == ".json" or fields["desc"] == "*":
            yield _output(key, **fields)
        else:
            images.append(_output(key, **fields))
    yield from images
    yield from _sidecars(images)


#: Files of one hemisphere that come with an option or another command. A ``*`` stands for the name
#: that the user gave.
EXTRA_OUTPUTS: tuple[Output, ...] = tuple(_of_extensions())

#: Tables of maps that the user names, by key.
NAMED_TABLES = [r.key for r in EXTRA_OUTPUTS if r.desc == "*" and r.extension == ".tsv"]

#: Lists of files in a quality record, each an entry with an address.
FILE_LISTS = ("inputs", "edited", "probabilities", "visits")

#: Files of the whole dataset, by the name of what they hold.
DATASET_FILES: dict[str, str] = {
    "description": "dataset_description.json",
    "readme": "README.md",
    "ignore": ".bidsignore",
    "settings": "desc-settings.json",
    "citation": "CITATION.md",
    "status": "status.tsv",
    "status_sidecar": "status.json",
    "measures": "measures.tsv",
    "measures_sidecar": "measures.json",
    "ratings": "ratings.tsv",
    "inputs": "inputs.tsv",
    "inputs_sidecar": "inputs.json",
    "logs": files.LOGS,
    "group": "group",
    "report": "report.html",
}

#: Lines of ``.bidsignore``, and why BIDS has no name for what each hides.
IGNORED: dict[str, str] = TEXTS["ignored"]

_IGNORE_HEAD = """\
# For the BIDS validator: files of this dataset without a name in BIDS 1.11. Patterns that begin
# with a slash are about this folder, the others about folders of participants, too. In a pattern,
# * stands for any characters, and [ab] for a or b."""

_RECORD = re.compile(
    r"sub-(?P<subject>[^_]+)(?:_ses-(?P<session>[^_]+))?_hemi-(?P<hemi>[LR])_seg-(?P<seg>[^_]+)"
    r"(?:_label-(?P<region>[^_]+))?_desc-qc_metrics\.json"
)

#: Images of maps that extensions may measure, by key.
ADDED_MAPS = {row.key: row for row in _of_extensions() if row.extension == ".shape.gii"}

_BY_KEY = {output.key: output for output in (*OUTPUTS, *EXTRA_OUTPUTS)}


def output_name(name: HemisphereName, key: str, desc: str | None = None) -> str:
    """File name of one output; ``desc`` is the name that the user gave a map."""
    output = _BY_KEY[key]
    entities = [
        name.stem,
        f"space-{output.space}" if output.space else None,
        name.protocol,
        f"desc-{desc or output.desc}" if output.desc else None,
        output.suffix,
    ]
    return "_".join(part for part in entities if part) + output.extension


def output_path(name: HemisphereName, key: str, desc: str | None = None) -> PurePosixPath:
    """Path of one output, relative to the output dataset.

    Parameters
    ----------
    name : HemisphereName
        Whose result it is.
    key : str
        A key of :data:`OUTPUTS` or :data:`EXTRA_OUTPUTS`.
    desc : str, optional
        The user's name of a map.

    Returns
    -------
    PurePosixPath
        ``sub-X[/ses-Y]/anat/sub-X[_ses-Y]_hemi-H[_space-S]_seg-P[_label-R][_desc-D]_<suffix><extension>``.

    Raises
    ------
    KeyError
        If there is no output of this key.
    """
    return name.folder / output_name(name, key, desc)


def output_pattern(key: str) -> str:
    """Glob pattern of one output of all hemispheres."""
    output = _BY_KEY[key]
    return f"*_{f'desc-{output.desc}_' if output.desc else ''}{output.suffix}{output.extension}"


def name_of_record(file_name: str) -> HemisphereName | None:
    """Identify whose quality record a file is: the reverse of :func:`output_name`."""
    match = _RECORD.fullmatch(file_name)
    if match is None:
        return None
    parts = match.groupdict()
    return HemisphereName(**parts | {"region": parts["region"] or "body"})


def natural_order(label: str) -> tuple[tuple[str | int, ...], str]:
    """Return a key that sorts labels with numbers by value: ``2`` before ``10``."""
    parts = re.split(r"([0-9]+)", label)  # text and numbers alternate
    return tuple(int(part) if i % 2 else part for i, part in enumerate(parts)), label


def participant_report(subject: str, session: str | None) -> str:
    """File name of the page about one visit, in the root of the output dataset."""
    return f"sub-{subject}{f'_ses-{session}' if session else ''}.html"


def group_report(model: str) -> str:
    """Path of the page about one analysis of the group level, in the output dataset."""
    return f"{DATASET_FILES['group']}/{model}.html"


def ignore_file() -> str:
    """Compose ``.bidsignore``: patterns of names that BIDS 1.11 has no rule for, and why."""
    endings = {f"_{row.suffix}{row.extension}" for row in _BY_KEY.values()}
    names = [*(f"/{name}" for name in DATASET_FILES.values()), *sorted(endings)]
    lines = [_IGNORE_HEAD]
    for pattern, reason in IGNORED.items():
        hidden = " ".join(name for name in names if fnmatchcase(name, pattern))
        lines += ["", f"# {reason}", *([f"# Hides {hidden}"] if hidden else ()), pattern]
    return "\n".join(lines) + "\n"


#: The sidecars that images of every hemisphere share, in the root of the dataset, as BIDS inherits
#: them; what a hemisphere's images come from is said next to them.
SHARED = tuple(row for row in OUTPUTS if row.images)

#: Where coordinates are, by the name of the space: ``orig`` is that of the segmentation.
_SPACES = {None: "orig", "unfold": "plane in which the sheet is laid flat to scale, mm"}


def write_shared(root: Path) -> None:
    """Write what holds for all hemispheres."""
    for row in SHARED:
        files.write_json(root / row.for_all, describe(row))


def describe(sidecar: Output) -> dict[str, str]:
    """Describe the images of a sidecar, from the table of outputs."""
    about = {
        "Description": _by_name(sidecar, lambda image: image.description),
        "SpatialReference": _by_name(sidecar, lambda image: _SPACES[image.space]),
        "Units": _by_name(sidecar, lambda image: image.unit or ""),
    }
    if sidecar.suffix == "mask":
        about["Type"] = "ROI"
    return {key: text for key, text in about.items() if text}


def _by_name(sidecar: Output, text_of: Callable[[Output], str]) -> str:
    """Join what is to be said of images that share a sidecar; those without entities come first."""
    names: dict[str, list[str]] = {}
    for image in sidecar.images:
        entity = f"space-{image.space}" if image.space else f"desc-{image.desc}"
        names.setdefault(text_of(image), []).append(entity)
    first, *further_texts = names
    return "; ".join([first, *(f"with {', '.join(names[text])}: {text}" for text in further_texts)])


def sources(record: Mapping[str, Any]) -> list[str]:
    """List the inputs of a quality record, with edits and other visits, as BIDS addresses."""
    entries = [entry for key in FILE_LISTS for entry in record.get(key) or ()]
    return list(dict.fromkeys(str(entry["file"]) for entry in entries))
