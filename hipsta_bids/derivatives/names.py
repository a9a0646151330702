"""The one table of outputs, and the one function that spells their paths.

Entities follow the order of BIDS 1.11 (``sub ses hemi space seg label desc``). What the standard
has no rule for is listed in ``.bidsignore`` from the same table.
"""

import re
from dataclasses import dataclass
from pathlib import PurePosixPath

from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.io.files import LOGS


@dataclass(frozen=True, kw_only=True)
class HemisphereName:
    """The BIDS identity of one result."""

    subject: str
    """Label without ``sub-``."""
    session: str | None
    """Label without ``ses-``; ``None`` where the dataset has no sessions."""
    hemi: str
    """``L`` or ``R``."""
    seg: str
    """Name of the segmentation protocol."""
    region: str = "body"
    """What was measured; other regions than the body are in the names, as ``label-``."""

    @property
    def protocol(self) -> str:
        """Entities that tell results of one hemisphere apart: protocol and region."""
        label = "" if self.region == "body" else f"_label-{self.region}"
        return f"seg-{self.seg}{label}"

    @property
    def pattern(self) -> str:
        """Glob pattern of its file names, in which no other region has a part."""
        # No suffix of the table begins as the entity label does.
        return f"{self.stem}_*{self.protocol}_{'[!l]*' if self.region == 'body' else '*'}"

    @property
    def stem(self) -> str:
        """What all file names of this hemisphere's subject and session begin with."""
        session = f"_ses-{self.session}" if self.session else ""
        return f"sub-{self.subject}{session}_hemi-{self.hemi}"

    @property
    def folder(self) -> PurePosixPath:
        """Folder of the results, relative to the output dataset."""
        session = [f"ses-{self.session}"] if self.session else []
        return PurePosixPath(f"sub-{self.subject}", *session, "anat")


@dataclass(frozen=True, kw_only=True)
class Output:
    """One row of the output table."""

    key: str
    suffix: str
    extension: str
    description: str
    desc: str | None = None
    space: str | None = None
    optional: bool = False
    """Written on request only."""
    in_standard: bool = False
    """Whether BIDS 1.11 has a rule for this name."""


_SURFACES = ("interior", "midthickness", "exterior")

#: Every file of one hemisphere. The quality record comes last: it is written when all else is
#: there, so that its presence means that the set is complete.
OUTPUTS: tuple[Output, ...] = (
    Output(
        key="sheet",
        desc="sheet",
        suffix="morph",
        extension=".tsv",
        description="one row per sheet point: position, thickness, curvatures, extents, subfield",
    ),
    Output(
        key="sheet_sidecar",
        desc="sheet",
        suffix="morph",
        extension=".json",
        description="columns, units and definitions of the sheet table",
    ),
    Output(
        key="summary",
        desc="summary",
        suffix="morph",
        extension=".tsv",
        description="one row: means of thickness, curvatures and cross-sections, extents, volume,"
        " areas and their ratios; some per subfield",
    ),
    Output(
        key="summary_sidecar",
        desc="summary",
        suffix="morph",
        extension=".json",
        description="columns, units and definitions of the summary table",
    ),
    *(
        row
        for table, description in (
            ("profile", "means along the sheet: one row per x (over y), then one per y (over x)"),
            ("sections", "one row per cross-section: lengths, area, ratio, shape index"),
        )
        for row in (
            Output(
                key=table, desc=table, suffix="morph", extension=".tsv", description=description
            ),
            Output(
                key=f"{table}_sidecar",
                desc=table,
                suffix="morph",
                extension=".json",
                description=f"columns, units and definitions of the {table} table",
            ),
        )
    ),
    *(
        Output(
            key=f"{name}_surface",
            suffix=name,
            extension=".surf.gii",
            description=f"{name} surface of the sheet in the scanner space of the subject",
        )
        for name in _SURFACES
    ),
    *(
        Output(
            key=f"{name}_unfold",
            suffix=name,
            space="unfold",
            extension=".surf.gii",
            description=f"{name} surface laid flat: medial to lateral, posterior to anterior",
        )
        for name in _SURFACES
    ),
    *(
        Output(
            key=row.name,
            desc=row.desc,
            suffix=row.suffix,
            extension=".shape.gii",
            description=f"{row.definition}; per surface vertex, {row.unit}",
        )
        for row in MAPS
    ),
    Output(
        key="subfields",
        suffix="dseg",
        extension=".label.gii",
        description="subfield per surface vertex",
        in_standard=True,
    ),
    Output(
        key="body_mask",
        desc="body",
        suffix="mask",
        extension=".nii.gz",
        description="the measured body on the grid of the labels; edit a copy to correct it",
    ),
    Output(
        key="layers",
        desc="layers",
        suffix="morph",
        extension=".tsv",
        description="one row per point of the three-dimensional grid: layer, depth, position"
        " (`--write-meshes`)",
        optional=True,
    ),
    Output(
        key="layers_sidecar",
        desc="layers",
        suffix="morph",
        extension=".json",
        description="columns, units and definitions of the layers table (`--write-meshes`)",
        optional=True,
    ),
    Output(
        key="mesh",
        desc="tet",
        suffix="mesh",
        extension=".vtu",
        description="tetrahedral mesh with its three coordinates (`--write-meshes`)",
        optional=True,
    ),
    Output(
        key="qc",
        desc="qc",
        suffix="metrics",
        extension=".json",
        description="status, reason, flags, inputs, and every number that says whether to trust"
        " the maps",
    ),
)

#: Files of one hemisphere that come with an option or another command. A ``*`` stands for the name
#: that the user gave.
EXTRA_OUTPUTS: tuple[Output, ...] = (
    Output(
        key="map_table",
        desc="*",
        suffix="map",
        extension=".tsv",
        description="another volume at each sheet point, one column per volume (`--map`)",
    ),
    Output(
        key="map_sidecar",
        desc="*",
        suffix="map",
        extension=".json",
        description="its source, how it was sampled, and how much of it is missing",
    ),
    Output(
        key="map_shape",
        desc="*",
        suffix="map",
        extension=".shape.gii",
        description="the same per surface vertex",
    ),
    Output(
        key="map_series",
        desc="*",
        suffix="map",
        extension=".func.gii",
        description="the same per surface vertex, where there are several volumes",
    ),
    Output(
        key="roi",
        desc="roi",
        suffix="morph",
        extension=".tsv",
        description="one row per region drawn on the sheet: points, area, mean and SD of the maps"
        " (`--roi`)",
    ),
    Output(
        key="roi_sidecar",
        desc="roi",
        suffix="morph",
        extension=".json",
        description="columns, units and definitions of the region table",
    ),
    Output(
        key="surrogate",
        desc="surrogate",
        suffix="morph",
        extension=".tsv",
        description="thickness from the medial axis of single slices (`hipsta-bids surrogate`)",
    ),
    Output(
        key="surrogate_sidecar",
        desc="surrogate",
        suffix="morph",
        extension=".json",
        description="columns, units and definitions of that table",
    ),
)

#: Files of the whole dataset, by the name of what they hold.
DATASET_FILES: dict[str, str] = {
    "description": "dataset_description.json",
    "ignore": ".bidsignore",
    "settings": "desc-settings.json",
    "citation": "CITATION.md",
    "status": "status.tsv",
    "status_sidecar": "status.json",
    "logs": LOGS,
    "group": "group",
    "report": "report.html",
}

_RECORD = re.compile(
    r"sub-(?P<subject>[^_]+)(?:_ses-(?P<session>[^_]+))?_hemi-(?P<hemi>[LR])_seg-(?P<seg>[^_]+)"
    r"(?:_label-(?P<region>[^_]+))?_desc-qc_metrics\.json"
)

_BY_KEY = {output.key: output for output in (*OUTPUTS, *EXTRA_OUTPUTS)}


def output_name(name: HemisphereName, key: str, desc: str | None = None) -> str:
    """Spell the file name of one output."""
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
    """Spell the path of one output, relative to the output dataset.

    Parameters
    ----------
    name : HemisphereName
        Whose result it is.
    key : str
        A key of :data:`OUTPUTS` or :data:`EXTRA_OUTPUTS`.
    desc : str, optional
        See :func:`output_name`.

    Returns
    -------
    PurePosixPath
        ``sub-X[/ses-Y]/anat/sub-X[_ses-Y]_hemi-H[_space-S]_seg-P[_label-R][_desc-D]_<suffix><extension>``.
    """
    return name.folder / output_name(name, key, desc)


def output_pattern(key: str) -> str:
    """Glob pattern of one output of all hemispheres."""
    output = _BY_KEY[key]
    return f"*_{f'desc-{output.desc}_' if output.desc else ''}{output.suffix}{output.extension}"


def name_of_record(file_name: str) -> HemisphereName | None:
    """Tell whose quality record a file is, the reverse of :func:`output_name`."""
    match = _RECORD.fullmatch(file_name)
    if match is None:
        return None
    parts = match.groupdict()
    return HemisphereName(**parts | {"region": parts["region"] or "body"})


def participant_report(subject: str, session: str | None) -> str:
    """Spell the name of the page about one visit, in the root of the output dataset."""
    return f"sub-{subject}{f'_ses-{session}' if session else ''}.html"


def group_report(model: str) -> str:
    """Spell the path of the page about one analysis of the group level, in the output dataset."""
    return f"{DATASET_FILES['group']}/{model}.html"


def ignore_patterns() -> tuple[str, ...]:
    """List the patterns of ``.bidsignore``: each output that BIDS 1.11 has no rule for."""
    dataset = [DATASET_FILES[key] for key in ("settings", "citation", "status", "status_sidecar")]
    patterns = dict.fromkeys(
        f"*_{output.suffix}{output.extension}"
        for output in (*OUTPUTS, *EXTRA_OUTPUTS)
        if not output.in_standard
    )
    regions = [
        f"*_label-*_{output.suffix}{output.extension}" for output in OUTPUTS if output.in_standard
    ]
    pages = ("*.html",)
    folders = [f"{DATASET_FILES[key]}/" for key in ("logs", "group")]
    return (*dataset, *pages, *folders, *patterns, *regions)
