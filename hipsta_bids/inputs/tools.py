"""Segmentations of HippUnfold, HSF, MAGeT Brain and NextBrain: tools without an option.

HippUnfold writes ``*_hemi-{L,R}_*desc-subfields*_dseg.nii.gz``; the order of entities differs
between its versions 0 to 2 (see "Output Files" in its documentation).
HSF writes ``*_{left,right}_hippocampus_seg.nii.gz`` beside the image. NextBrain writes
``seg.{left,right}.nii.gz`` (or ``seg_{left,right}.mgz``) beside a copy of its label table. MAGeT
Brain writes both hemispheres to one file, ``*_label*.nii.gz``: others use such names too.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hipsta_bids.errors import HipstaError, InputError, ProtocolError
from hipsta_bids.inputs import scan
from hipsta_bids.inputs.selection import Selection, SidedFile, choose_file
from hipsta_bids.io.files import entities
from hipsta_bids.protocols.load import load_protocol, protocol_names
from hipsta_bids.protocols.protocol import Protocol

_SIDES = {"left": "L", "right": "R"}

#: Why a file was passed over, by its rank.
_ORDER = ("as good as the first one", "T2w comes first")


@dataclass(frozen=True, kw_only=True)
class _Tool:
    name: str
    """As in ``Protocol.tool``."""
    title: str
    pattern: re.Pattern[str]
    """Of its files; ``side`` is left or right, and there is no such group for both."""
    beside: frozenset[str] = frozenset()
    """Files of which one lies beside those of the tool; none are needed if empty."""
    distinct: bool = True
    """No other program uses such names; else the user or the dataset has to name the tool."""
    choice: str = ""
    """What the user has to know where there are several protocols."""


_TOOLS = (
    _Tool(
        name="hsf",
        title="HSF",
        pattern=re.compile(r".+_(?P<side>left|right)_hippocampus_seg\.nii(?:\.gz)?"),
        choice="HSF's codes depend on its ca_mode, which the file does not tell",
    ),
    _Tool(
        name="maget",
        title="MAGeT Brain",
        pattern=re.compile(r".+_labels?(?:_\w+)?\.(?:nii|nii\.gz|mgz)"),
        distinct=False,
    ),
    _Tool(
        name="nextbrain",
        title="NextBrain",
        pattern=re.compile(r"seg[._](?P<side>left|right)\.(?:nii\.gz|nii|mgz)"),
        beside=frozenset({"lut.txt", "lookup_table.txt"}),
    ),
)


def find_tools(
    visit: scan.VisitFolders, source: scan.Source, selection: Selection
) -> Iterator[scan.HemisphereInput]:
    """Find the segmentations of these tools in one visit."""
    for tool in _TOOLS:
        candidates = [
            file for folder in visit.folders for file in _files(folder, tool, source, selection)
        ]
        candidates.sort(key=lambda file: (file.rank, str(file.path)))
        for hemi in selection.wanted_hemis():
            files = [file for file in candidates if file.hemi in (hemi, None)]
            if not files:
                continue
            protocol, explanation, problem = _protocol(files[0].path, tool, selection)
            yield choose_file(
                files,
                visit,
                hemi,
                source,
                candidate=(protocol, problem),
                explanation=(tool.title, f", {explanation}"),
                passed_over=[(file.path.name, _ORDER[file.rank[0]]) for file in files[1:]],
            )


def _files(
    folder: scan.Folder, tool: _Tool, source: scan.Source, selection: Selection
) -> Iterator[SidedFile]:
    """List the files of one tool in a folder."""
    named = tool.name == (selection.protocol.tool if selection.protocol else None) or any(
        tool.name in generator for generator in source.generators
    )
    marked = not tool.beside or not tool.beside.isdisjoint(folder.names)
    if not (named or (tool.distinct and marked)):
        return
    for name in folder.names:
        match = tool.pattern.fullmatch(name)
        if match and selection.wants_file(folder.path / name):
            side = match.groupdict().get("side")
            # T2-weighted images, which show the subfields, before others.
            rank = int("T2w" not in name)
            hemi = _SIDES[side] if side else None
            yield SidedFile(path=folder.path / name, hemi=hemi, rank=(rank,))


def _protocol(
    path: Path, tool: _Tool, selection: Selection
) -> tuple[Protocol, str, HipstaError | None]:
    """Find the protocol of a tool's file: which, why this one, and what is wrong."""
    users = selection.protocol
    if users is not None and users.tool == tool.name:
        return users, f"protocol {users.name} from --scheme", None
    fitting = [
        protocol for name in protocol_names() if (protocol := load_protocol(name)).tool == tool.name
    ]
    if len(fitting) == 1:
        return fitting[0], f"protocol {fitting[0].name}", None
    names = " or ".join(f"--scheme {each.name} ({each.title})" for each in fitting)
    problem = ProtocolError(f"{path}: {tool.choice}; say which: {names}", reason="ambiguous-scheme")
    return (
        scan.unknown_protocol(tool.name, f"{tool.title}, mode not given"),
        "mode not given",
        problem,
    )


_HIPPUNFOLD = "hippunfold"

#: Atlases with the bundled protocol's codes, best first; None is version 0, which had one atlas.
_ATLASES = ("multihist7", "bigbrain", None)

_IMAGES = {".nii.gz", ".nii"}


@dataclass(frozen=True, kw_only=True)
class _UnfoldFile:
    path: Path
    space: str
    atlas: str | None

    @property
    def cropped(self) -> bool:
        return self.space.startswith("crop")

    @property
    def scaled(self) -> bool:
        """In a space that differs from the subject's own by more than rotation and shift."""
        # corobl is reached by an affine registration to a template unless asked otherwise.
        return self.space not in {"", "T1w", "T2w"} and not self.cropped

    @property
    def rank(self) -> tuple[bool, int, bool, str]:
        atlas = _ATLASES.index(self.atlas) if self.atlas in _ATLASES else len(_ATLASES)
        return self.scaled, atlas, not self.cropped, self.path.name


def is_hippunfold(name: str, source: scan.Source) -> bool:
    """Check whether a file is HippUnfold's segmentation of hippocampal subfields."""
    if "desc-subfields" not in name or "_hemi-" not in name:
        return False
    if source.generators and not any(_HIPPUNFOLD in name for name in source.generators):
        return False
    pairs = entities(name)
    return (
        pairs["suffix"] == "dseg"
        and pairs["extension"] in _IMAGES
        and pairs.get("desc") == "subfields"
        and pairs.get("label", "hipp") == "hipp"
    )


def find_hippunfold(
    visit: scan.VisitFolders, source: scan.Source, selection: Selection
) -> Iterator[scan.HemisphereInput]:
    """Find HippUnfold's segmentations of one visit.

    ``space-crop*`` comes first (the finest grid in the subject's own space), then the image's own
    grid. Files in coronal-oblique and template spaces may be scaled, and are not used.
    """
    for hemi in selection.wanted_hemis():
        files = sorted(_unfold_files(visit, hemi, source, selection), key=lambda file: file.rank)
        if not files:
            continue
        best = files[0]
        is_known = best.atlas in _ATLASES
        users = selection.protocol if not is_known and selection.describes(_HIPPUNFOLD) else None
        note = "labels on the image's own grid, which may be coarse; no space-crop* file exists"
        yield scan.HemisphereInput(
            subject=visit.subject,
            session=visit.session,
            hemi=hemi,
            protocol=users or load_protocol("hippunfold"),
            files=(best.path,),
            source=source.name,
            source_path=source.path,
            explanation=f"space {best.space or 'not named'}, atlas {best.atlas or 'not named'}",
            passed_over=tuple((file.path.name, _unfold_reason(file, best)) for file in files[1:]),
            problem=_unfold_problem(best, is_known=is_known or users is not None),
            notes=() if best.cropped else (note,),
        )


def _unfold_files(
    visit: scan.VisitFolders, hemi: str, source: scan.Source, selection: Selection
) -> Iterator[_UnfoldFile]:
    for folder in visit.folders:
        for name in folder.names:
            if not is_hippunfold(name, source):
                continue
            pairs = entities(name)
            path = folder.path / name
            if pairs["hemi"] == hemi and selection.wants_file(path):
                yield _UnfoldFile(path=path, space=pairs.get("space", ""), atlas=pairs.get("atlas"))


def _unfold_reason(file: _UnfoldFile, best: _UnfoldFile) -> str:
    if file.scaled:
        return f"space {file.space} may be scaled, which changes thickness"
    if file.atlas != best.atlas:
        return f"atlas {best.atlas} comes first; a --bids-filter-file selects another one"
    if best.cropped and not file.cropped:
        return f"coarser grid than space {best.space}"
    return "as good as the first one; a --bids-filter-file selects it"


def _unfold_problem(file: _UnfoldFile, *, is_known: bool) -> HipstaError | None:
    if file.scaled:
        return InputError(
            f"{file.path}: space {file.space} may be scaled, which changes thickness; "
            "run HippUnfold with its default output space",
            reason="template-space",
        )
    if not is_known:
        return ProtocolError(
            f"{file.path}: no bundled protocol for HippUnfold's atlas {file.atlas}; "
            "describe its labels in a TOML file and pass it with --scheme",
            reason="unknown-atlas",
        )
    return None
