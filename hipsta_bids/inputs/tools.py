"""Segmentations of HSF, MAGeT Brain and NextBrain: tools without an option of their own.

HSF writes ``*_{left,right}_hippocampus_seg.nii.gz`` beside the image. NextBrain writes
``seg.{left,right}.nii.gz`` (or ``seg_{left,right}.mgz``) beside a copy of its label table. MAGeT
Brain writes both hemispheres to one file, ``*_label*.nii.gz``: others use such names too.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hipsta_bids.errors import HipstaError, InputError, ProtocolError
from hipsta_bids.inputs.scan import (
    Folder,
    HemisphereInput,
    Selection,
    Source,
    VisitFolders,
    unknown_protocol,
)
from hipsta_bids.protocols.load import load_protocol, protocol_names
from hipsta_bids.protocols.protocol import Protocol

_SIDES = {"left": "L", "right": "R"}


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


@dataclass(frozen=True, kw_only=True)
class _File:
    path: Path
    hemi: str | None
    """None for both."""

    @property
    def rank(self) -> bool:
        """T2-weighted images, which show the subfields, before others."""
        return "T2w" not in self.path.name


def find_tools(
    visit: VisitFolders, source: Source, selection: Selection
) -> Iterator[HemisphereInput]:
    """Find the segmentations of these tools in one visit."""
    for tool in _TOOLS:
        found = [
            file for folder in visit.folders for file in _files(folder, tool, source, selection)
        ]
        found.sort(key=lambda file: (file.rank, str(file.path)))
        for hemi in selection.wanted_hemis():
            files = [file for file in found if file.hemi in (hemi, None)]
            if files:
                yield _choose(files, tool, hemi, visit, source=source, selection=selection)


def _files(folder: Folder, tool: _Tool, source: Source, selection: Selection) -> Iterator[_File]:
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
            yield _File(path=folder.path / name, hemi=_SIDES[side] if side else None)


def _choose(
    files: list[_File],
    tool: _Tool,
    hemi: str,
    visit: VisitFolders,
    *,
    source: Source,
    selection: Selection,
) -> HemisphereInput:
    chosen = files[0]
    bilateral = chosen.hemi is None
    protocol, why, problem = _protocol(chosen.path, tool, selection)
    rivals = [file.path.name for file in files if file.rank == chosen.rank]
    if len(rivals) > 1:
        problem = InputError(
            f"{chosen.path.parent}: {' and '.join(rivals)} are equally good; "
            "keep one of them in the subject's folder",
            reason="several-files",
        )
    return HemisphereInput(
        subject=visit.subject,
        session=visit.session,
        hemi=hemi,
        protocol=protocol,
        files=(chosen.path,),
        bilateral=bilateral,
        code_offset=protocol.shift(hemi) if bilateral else 0,
        source=source.name,
        source_path=source.path,
        why=f"{tool.title}{', both hemispheres in one file' if bilateral else ''}, {why}",
        passed_over=tuple(
            (file.path.name, "as good as the first one" if not file.rank else "T2w comes first")
            for file in files[1:]
        ),
        problem=problem,
    )


def _protocol(
    path: Path, tool: _Tool, selection: Selection
) -> tuple[Protocol, str, HipstaError | None]:
    """Find the protocol of a tool's file: which, why this one, and what is wrong."""
    users = selection.protocol
    if users is not None and users.tool == tool.name:
        return users, f"protocol {users.name} from --scheme", None
    known = [
        protocol for name in protocol_names() if (protocol := load_protocol(name)).tool == tool.name
    ]
    if len(known) == 1:
        return known[0], f"protocol {known[0].name}", None
    names = " or ".join(f"--scheme {each.name} ({each.title})" for each in known)
    problem = ProtocolError(f"{path}: {tool.choice}; say which: {names}", reason="ambiguous-scheme")
    return unknown_protocol(tool.name, f"{tool.title}, mode not given"), "mode not given", problem
