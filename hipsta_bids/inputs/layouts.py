"""Layouts of programs that segment subfields: rows of a table, functions for what is special."""

import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from hipsta_bids.errors import InputError, ProtocolError
from hipsta_bids.inputs import ashs, freesurfer, generic, scan, tree
from hipsta_bids.inputs.selection import Context, LabelFile, Verdict
from hipsta_bids.io.files import entities
from hipsta_bids.protocols.load import load_protocol, protocol_names

_SIDES = {"left": "L", "right": "R", "l": "L", "r": "R"}


def _named_protocol(layout: "Layout", file: LabelFile, context: Context, _: str) -> Verdict:
    """Find the protocol of a program's file."""
    users, names = context.selection.protocol, protocol_names()
    fitting = [protocol for protocol in map(load_protocol, names) if protocol.tool == layout.name]
    if users is not None and users.tool == layout.name:
        fitting = [users]
    if len(fitting) == 1:
        origin = " from --scheme" if users in fitting else ""
        explanation = f"{layout.title}{file.remark}, protocol {fitting[0].name}{origin}"
        return Verdict(protocol=fitting[0], explanation=explanation)
    choices = " or ".join(f"--scheme {protocol.name} ({protocol.title})" for protocol in fitting)
    return Verdict(
        protocol=scan.unknown_protocol(layout.name, f"{layout.title}, mode not given"),
        explanation=f"{layout.title}{file.remark}, mode not given",
        problem=ProtocolError(
            f"{file.path}: {layout.choice}; name one: {choices}", reason="ambiguous-scheme"
        ),
    )


def _t2_first(file: LabelFile, _: Context) -> tuple[Any, ...]:
    """Rank T2-weighted images, which show the subfields, before others."""
    return (int("T2w" not in file.path.name),)


def _t2_reason(file: LabelFile, _: LabelFile) -> str:
    return "T2w is preferred" if file.rank[0] else "as good as the first one"


@dataclass(frozen=True, kw_only=True)
class Layout:
    """The files of one program."""

    name: str
    """As in ``Protocol.tool``."""
    title: str
    kind: str = "tools"
    """Kind of folder that it is in (``scan.LAYOUTS``)."""
    mark: str
    """Part of all of its names."""
    pattern: re.Pattern[str]
    """Of its names. A group ``hemi`` is the side, and there is none for both."""
    bids: bool = True
    """Names have BIDS' entities, by which a filter file selects."""
    rank: Callable[[LabelFile, Context], tuple[Any, ...]] = _t2_first
    """Order of preference, the least first; equal ones are not chosen between."""
    reason: Callable[[LabelFile, LabelFile], str] = _t2_reason
    """Why a file is passed over for the best one."""
    protocol: Callable[["Layout", LabelFile, Context, str], Verdict] = _named_protocol
    """Which protocol the best file has."""
    choose: Callable[[list[LabelFile], Context, str], Iterable[scan.HemisphereInput]] | None = None
    """Where more than one file matters: which, and how."""
    companions: Sequence[str] = ()
    """Files of which one lies next to those of the program; none are needed if empty."""
    distinct: bool = True
    """No other program uses such names; else the user or the dataset has to name this one."""
    generators: bool = False
    """Datasets that name other software hold none of its files."""
    unless: str = ""
    """Layout whose files are not of this one."""
    choice: str = ""
    """What the user has to know where there are several protocols."""
    volumes: str = ""
    """Name of the table of volumes next to a file."""
    probabilities: str = ""
    """Pattern of names of probabilities. It takes groups of the name of labels, ``side``, and
    FreeSurfer's ``run``; a group ``label`` is the label's code or name."""
    near: Sequence[str] = (".",)
    """Folders in which they may be, relative to the folder of the labels."""
    weights: bool = False
    """Their values are weights, which their sum makes probabilities."""

    def reads(self, name: str, source: scan.Source) -> dict[str, str | None] | None:
        """Return the entities of a file's name, if it is one of this program's."""
        match = self.pattern.fullmatch(name)
        is_foreign = self.generators and source.generators and not self.made(source)
        if match is None or is_foreign:
            return None
        if self.unless and _BY_NAME[self.unless].reads(name, source) is not None:
            return None
        return (entities(name) if self.bids else {}) | {"hemi": None, **match.groupdict()}

    def made(self, source: scan.Source) -> bool:
        """Check whether a dataset names this program in its description."""
        return any(self.name in generator for generator in source.generators)

    def side(self, name: str) -> str | None:
        """Return the hemisphere of a file by its name; None for both."""
        match = self.pattern.fullmatch(name)
        return _SIDES.get(((match and match.groupdict().get("hemi")) or "").lower())

    def files(self, context: Context) -> list[LabelFile]:
        """List the files of one visit, best first."""
        source, users = context.source, context.selection.protocol
        named = (users is not None and users.tool == self.name) or self.made(source)
        files = []
        for folder in freesurfer.each_once(context.visit.folders):
            marked = not self.companions or any(name in folder.names for name in self.companions)
            if not (named or (self.distinct and marked)):
                continue
            for name in [name for name in folder.names if self.mark in name]:
                traits, path = self.reads(name, source), folder.path / name
                if traits is None or (self.bids and not context.selection.wants_file(path)):
                    continue
                file = LabelFile(
                    path=path, hemi=self.side(name), traits=traits, longitudinal=folder.longitudinal
                )
                files.append(replace(file, rank=self.rank(file, context)))
        return sorted(files, key=lambda file: (file.rank, str(file.path)))


def find(layout: Layout, context: Context) -> Iterator[scan.HemisphereInput]:
    """Find the segmentations of one program in one visit."""
    all_files = layout.files(context)
    if not all_files:
        return
    context = replace(context, longitudinal=freesurfer.is_longitudinal(all_files))
    for hemi in context.selection.wanted_hemis():
        files = [file for file in all_files if file.hemi in (hemi, None)]
        if files and layout.choose is not None:
            yield from layout.choose(files, context, hemi)
        elif files:
            verdict = layout.protocol(layout, files[0], context, hemi)
            passed_over = [(file.path, layout.reason(file, files[0])) for file in files[1:]]
            yield context.first(files, verdict, hemi, passed_over, tool=layout.name)


def volume_table(path: Path, name: str) -> Path | None:
    """Name the table of volumes that a program wrote with a segmentation."""
    layout = _BY_NAME[name]
    match = layout.pattern.fullmatch(path.name)
    return None if match is None else path.with_name(layout.volumes.format(**match.groupdict()))


# What HippUnfold writes differs by space and atlas.

#: Atlases with the bundled protocol's codes, best first; None is version 0, which had one atlas.
_ATLASES = ("multihist7", "bigbrain", None)


def _space(file: LabelFile) -> str:
    return file.traits.get("space") or ""


def _cropped(file: LabelFile) -> bool:
    return _space(file).startswith("crop")


def _scaled(file: LabelFile) -> bool:
    """Check for a space that differs from the subject's by more than rotation and shift."""
    # corobl is reached by an affine registration to a template unless asked otherwise.
    return _space(file) not in {"", "T1w", "T2w"} and not _cropped(file)


def _unfold_rank(file: LabelFile, _: Context) -> tuple[Any, ...]:
    """Rank the finest grid in the subject's space (``space-crop*``), then that of the image."""
    atlas = file.traits.get("atlas")
    index = _ATLASES.index(atlas) if atlas in _ATLASES else len(_ATLASES)
    return _scaled(file), index, not _cropped(file)


def _unfold_reason(file: LabelFile, best: LabelFile) -> str:
    if _scaled(file):
        return f"space {_space(file)} may be scaled, which changes thickness"
    if file.traits.get("atlas") != best.traits.get("atlas"):
        atlas = best.traits.get("atlas")
        return f"atlas {atlas} is preferred; a --bids-filter-file selects another one"
    if _cropped(best) and not _cropped(file):
        return f"coarser grid than space {_space(best)}"
    return "as good as the first one"


def _unfold_protocol(layout: Layout, file: LabelFile, context: Context, _: str) -> Verdict:
    """Take the bundled protocol for its atlases, and the user's for others."""
    atlas, selection = file.traits.get("atlas"), context.selection
    is_known = atlas in _ATLASES
    users = selection.protocol if not is_known and selection.describes(layout.name) else None
    problem: InputError | ProtocolError | None = None
    if _scaled(file):
        problem = InputError(
            f"{file.path}: space {_space(file)} may be scaled, which changes thickness; "
            "run HippUnfold with its default output space",
            reason="template-space",
        )
    elif not is_known and users is None:
        problem = ProtocolError(
            f"{file.path}: no bundled protocol for HippUnfold's atlas {atlas}; "
            "describe its labels in a TOML file and pass it with --scheme",
            reason="unknown-atlas",
        )
    note = "labels on the image's own grid, which may be coarse; no space-crop* file exists"
    return Verdict(
        protocol=users or load_protocol(layout.name),
        explanation=f"space {_space(file) or 'not named'}, atlas {atlas or 'not named'}",
        problem=problem,
        notes=() if _cropped(file) else (note,),
    )


# What ASHS writes differs by step, and its atlas is identified by table or values.

#: ASHS's last step comes first.
_KINDS = ("corr_usegray", "corr_nogray", "heur")


def _ashs_rank(file: LabelFile, context: Context) -> tuple[Any, ...]:
    """Rank one hemisphere before both, later steps before earlier, final before others."""
    outside = file.path.parent.name != "final"
    other_id = f"sub-{context.visit.subject}" not in file.path.name
    return file.hemi is None, _KINDS.index(file.traits["kind"] or ""), outside, other_id


def _ashs_reason(file: LabelFile, best: LabelFile) -> str:
    if file.hemi is None and best.hemi is not None:
        return "both hemispheres in one file; one file per hemisphere is preferred"
    if file.rank[1] != best.rank[1]:
        return f"{best.traits['kind']} is preferred to {file.traits['kind']}"
    if file.rank == best.rank:
        return "as good as the first one"
    return "files in final/ and with the subject's label are preferred"


def _ashs_protocol(_: Layout, file: LabelFile, context: Context, hemi: str) -> Verdict:
    """Identify the atlas."""
    return (context.identify_atlas or atlas_finder(context).identify)(file, hemi)


#: Subjects whose files are opened to find out a dataset's atlas, spread over the dataset.
_SAMPLE = 8


def atlas_finder(context: Context) -> ashs.AtlasFinder:
    """Prepare what identifies the atlases of one dataset of ASHS."""

    def sample() -> Iterator[ashs.Image]:
        """List some of the dataset's segmentations, the same whoever is processed."""
        folders = context.source.folders()[0]
        for visit in tree.list_visits(folders[:: max(len(folders) // _SAMPLE, 1)]):
            files = _BY_NAME["ashs"].files(replace(context, visit=visit))
            for hemi in scan.HEMIS:
                best = next((file for file in files if file.hemi in (hemi, None)), None)
                if best is not None:
                    yield best.path, hemi, best.hemi is None

    return ashs.AtlasFinder(context.source.path, context.atlas, sample)


#: Steps that differ between programs.
_SPECIAL: dict[str, dict[str, Any]] = {
    "freesurfer": {"choose": freesurfer.choose_run},
    "ashs": {"rank": _ashs_rank, "reason": _ashs_reason, "protocol": _ashs_protocol},
    "hippunfold": {"rank": _unfold_rank, "reason": _unfold_reason, "protocol": _unfold_protocol},
    "named": {"choose": generic.choose_described},
}

_BY_NAME = {
    name: Layout(name=name, pattern=re.compile(row.pop("pattern")), **row, **_SPECIAL.get(name, {}))
    for name, row in tomllib.loads(
        (resources.files("hipsta_bids.inputs") / "layouts.toml").read_text("utf-8")
    ).items()
}
LAYOUTS = tuple(_BY_NAME.values())

#: What all names of labels have in part.
_MARKS = re.compile("|".join(re.escape(layout.mark) for layout in LAYOUTS))


def layout_of(name: str) -> Layout | None:
    """Find the layout whose files have a name like this."""
    if not _MARKS.search(name):
        return None
    return next((layout for layout in LAYOUTS if layout.pattern.fullmatch(name)), None)
