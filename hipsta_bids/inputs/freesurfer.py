"""FreeSurfer's hippocampal subfields: ``mri/{lh,rh}.hippoAmygLabels*`` and ``hippoSfLabels*``.

File names consist of the analysis (which scans, and the version: ``-T1.v22``, ``-T1-T2.v21``), the
hierarchy (``.CA``, ``.FS60``, ``.HBT``; nothing for the full one) and ``.FSvoxelSpace`` for a copy
resampled to 1 mm. ``segment_subregions`` (FreeSurfer 7.3 and later) has ``--suffix`` in place of
the analysis, ``.long`` in longitudinal folders, and otherwise nothing. It also runs in FastSurfer's
folders, which have the same layout.
"""

import contextlib
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hipsta_bids import opening
from hipsta_bids.errors import HipstaError, InputError
from hipsta_bids.inputs import scan, tree
from hipsta_bids.inputs.selection import DESIGNS, Context, LabelFile, Verdict
from hipsta_bids.protocols.load import load_protocol

#: FreeSurfer 6.0, whose files have no hierarchies.
_OLD = "hippoSfLabels"

#: Ways to get subfields, best first: hierarchy with subfields, with parts, and the protocol.
#: FS60 comes before CA because it keeps the molecular layer apart.
_WAYS = (
    ("full", None, "freesurfer"),
    ("FS60", "HBT", "freesurferFS60"),
    ("CA", "HBT", "freesurferCA"),
    ("FS60", None, "freesurferFS60"),
    ("CA", None, "freesurferCA"),
)

_UNNAMED = "unnamed"


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of FreeSurfer's subfield segmentation, by the suffix of its files, and its files."""

    scans: tuple[str, ...]
    """``("T1",)``, ``("T1", "T2")``, or nothing."""
    longitudinal: bool
    version: int | None
    coarse: bool
    old: bool
    files: dict[str, Path] = field(default_factory=dict)
    """By hierarchy."""

    @property
    def name(self) -> str:
        """As ``--fs-analysis`` takes it."""
        long = ["long"] if self.longitudinal else []
        version = [f"v{self.version}"] if self.version is not None else []
        scans = ["-".join(self.scans)] if self.scans else []
        return ".".join([*scans, *long, *version]) or _UNNAMED

    @property
    def rank(self) -> tuple[object, ...]:
        """Order of preference: cross-sectional, most scans, T2 before T1, newest version."""
        scans = {0: 3, 1: 2 if self.scans == ("T1",) else 1}.get(len(self.scans), 0)
        version = -(self.version or 0)
        return self.coarse, self.longitudinal, scans, version, self.old, self.way is None

    @property
    def way(self) -> tuple[str, str | None, str] | None:
        """The best way to get subfields from these files."""
        have = self.files.keys()
        return next((way for way in _WAYS if {way[0], way[1] or way[0]} <= have), None)

    def answers(self, request: "Run | None", *, longitudinal: bool) -> bool:
        """Check whether this is the wanted analysis (of any version, if none is wanted)."""
        if request is None:
            return self.longitudinal == longitudinal
        is_version = request.version in (None, self.version)
        key = (self.scans, self.longitudinal)
        return is_version and key == (request.scans, request.longitudinal)


def parse_analysis(
    text: str, *, longitudinal: bool = False, coarse: bool = False, old: bool = False
) -> Run:
    """Understand a suffix such as ``-T1-T2.v21`` or ``.long``, or a user's spelling of it."""
    words = [word for word in re.split(r"[-._]", text) if word and word != _UNNAMED]
    versions = [int(word[1:]) for word in words if re.fullmatch(r"v\d+", word)]
    return Run(
        scans=tuple(word for word in words if not re.fullmatch(r"long|v\d+", word)),
        longitudinal=longitudinal or "long" in words,
        version=versions[0] if versions else None,
        coarse=coarse,
        old=old,
    )


def posterior_run(analysis: str) -> str:
    """Write the analysis of labels (``-T1-T2.v22``) as names of posteriors do (``v22_T2``)."""
    run = parse_analysis(analysis)
    scans = run.scans[1:] if run.scans[:1] == ("T1",) else run.scans
    return "_".join([f"v{run.version}", *(["-".join(scans)] if scans else [])])


def choose_run(
    files: Sequence[LabelFile], context: Context, hemi: str
) -> Iterator[scan.HemisphereInput]:
    """Choose one hemisphere's files among FreeSurfer's.

    Taken are the files that are not resampled, of the preferred analysis (see
    :attr:`Analysis.rank`), in the full hierarchy; else ``.FS60`` or ``.CA``, combined with
    ``.HBT`` where that exists.
    """
    analysis = context.selection.fs_analysis
    request = parse_analysis(analysis) if analysis else None
    runs = _runs(files)
    matching = [run for run in runs if run.answers(request, longitudinal=context.longitudinal)]
    best = next((run for run in matching if run.way), None)
    run = best or runs[0]
    subfields, parts, protocol = run.way or (next(iter(run.files)), None, "freesurfer")
    names = list(filter(None, (subfields, parts)))
    paths = [run.files[name] for name in names]
    coarse = "only .FSvoxelSpace exists: labels resampled to 1 mm lose thin layers"
    verdict = Verdict(
        protocol=load_protocol("freesurferFS60" if run.old and run.way else protocol),
        parts_protocol=load_protocol("freesurferHBT") if parts else None,
        explanation=_why(run, subfields, parts, analysis),
        problem=None if best else _problem(runs, matching, analysis),
        notes=(coarse,) if best and run.coarse else (),
        provenance=_provenance(run, names),
    )
    yield context.input(hemi, verdict, paths, _passed_over(runs, run, paths))


def _provenance(run: Run, hierarchies: Iterable[str]) -> dict[str, str | None]:
    return {
        "tool": "freesurfer",
        "version": _version(run),
        "analysis": "-".join(run.scans) or _UNNAMED,
        "hierarchy": "+".join(hierarchies),
        "space": "FSvoxelSpace" if run.coarse else None,
        "design": DESIGNS[run.longitudinal],
    }


def _version(run: Run) -> str | None:
    """Read the version of the subfields in the file's name, or else that of FreeSurfer itself."""
    if run.version is not None:
        return f"v{run.version}"
    stamp = next(iter(run.files.values())).parent.parent / "scripts" / "build-stamp.txt"
    with contextlib.suppress(OSError, ValueError):
        match = re.search(r"\d+\.\d+(?:\.\d+)?", opening.read_text(stamp, opening.SETTINGS))
        return match[0] if match else None
    return None


def is_longitudinal(files: Iterable[LabelFile]) -> bool:
    """Choose between the kinds of runs of a visit: both sides are of one, cross-sectional first.

    The longitudinal run is first only if it alone has more sides.
    """
    sides: dict[bool, set[str | None]] = {False: set(), True: set()}
    for file in files:
        longitudinal = "long" in re.split(r"[-._]", file.traits.get("analysis") or "")
        sides[file.longitudinal or longitudinal].add(file.hemi)
    return len(sides[True]) > len(sides[False])


def _runs(files: Iterable[LabelFile]) -> list[Run]:
    """Group a hemisphere's files by analysis and resolution, best first."""
    runs: dict[tuple[object, ...], Run] = {}
    for file in files:
        traits = file.traits
        run = parse_analysis(
            traits["analysis"] or "",
            longitudinal=file.longitudinal,
            coarse=traits["coarse"] is not None,
            old=traits["base"] == _OLD,
        )
        run = runs.setdefault((str(file.path.parent), run.name, run.coarse, run.old), run)
        # Of several formats, the first by name: .mgz before .nii.
        run.files.setdefault(traits["hierarchy"] or "full", file.path)
    return sorted(runs.values(), key=lambda run: run.rank)


def each_once(folders: tuple[tree.Folder, ...]) -> tuple[tree.Folder, ...]:
    """Exclude longitudinal folders that are links to others here, as FastSurfer's tools make."""
    if not any(folder.longitudinal for folder in folders):
        return folders
    paths = {os.path.realpath(folder.path) for folder in folders if not folder.longitudinal}
    return tuple(f for f in folders if not f.longitudinal or os.path.realpath(f.path) not in paths)


def _why(run: Run, subfields: str, parts: str | None, requested: str | None) -> str:
    hierarchy = "full hierarchy" if subfields == "full" else f"subfields from .{subfields}"
    if run.old:
        hierarchy = "subfields of FreeSurfer 6.0"
    combined = f", head/body/tail from .{parts}" if parts else ""
    choice = " (--fs-analysis)" if requested else ""
    return f"{hierarchy}{combined}, analysis {run.name}{choice}"


def _passed_over(runs: list[Run], best: Run, used_paths: list[Path]) -> Iterator[tuple[Path, str]]:
    for run in runs:
        name = run.name
        for hierarchy, path in run.files.items():
            reason = f"analysis {name} is later by default; --fs-analysis {name} selects it"
            if run.coarse and not best.coarse:
                reason = "resampled to 1 mm; a finer file exists"
            elif run is best:
                reason = f"{hierarchy} hierarchy: less detail than the one taken"
            if path not in used_paths:
                yield path, reason


def _problem(runs: list[Run], matching: list[Run], requested: str | None) -> HipstaError:
    folder = next(iter(runs[0].files.values())).parent
    if requested and not matching:
        names = ", ".join(dict.fromkeys(run.name for run in runs))
        return InputError(
            f"{folder}: no analysis {requested} here (found {names}); change --fs-analysis",
            reason="analysis-missing",
        )
    if not matching:
        kind = "longitudinal" if runs[0].longitudinal else "cross-sectional"
        return InputError(
            f"{folder}: this side has a {kind} run only, and the visit's other side another kind; "
            "choose with --fs-analysis",
            reason="analysis-missing",
        )
    return InputError(
        f"{folder}: only head/body/tail (.HBT) files, no subfields; run the segmentation again",
        reason="no-subfields",
    )
