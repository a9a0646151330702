"""ASHS's segmentations: ``*_{left,right}_lfseg_{corr_usegray,corr_nogray,heur}.nii.gz``.

They lie in ``final/`` below the subject's folder or directly in it. The part of the name that
ASHS takes for the subject's ID is often wrong; the folder decides. A file without ``left`` or
``right`` carries both hemispheres.
"""

import re
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

from hipsta_bids.errors import HipstaError, InputError, ProtocolError
from hipsta_bids.inputs import scan
from hipsta_bids.inputs.generic import find_table, read_table, table_protocol
from hipsta_bids.inputs.labels import label_values
from hipsta_bids.inputs.selection import Selection, SidedFile, choose_file, measurable
from hipsta_bids.protocols.load import agrees, load_protocol, protocol_names
from hipsta_bids.protocols.protocol import Protocol, Tissue

_TOOL = "ashs"

_NAME = re.compile(r"(?P<stem>.*?)_?lfseg_(?P<kind>corr_usegray|corr_nogray|heur)\.nii(?:\.gz)?")
_SIDES = {"left": "L", "right": "R"}

#: ASHS's last step comes first.
_KINDS = ("corr_usegray", "corr_nogray", "heur")

#: Tissues that an atlas without subfields labels in everyone.
_ALWAYS = {Tissue.HIPPOCAMPUS, Tissue.ENTORHINAL, Tissue.BA35, Tissue.BA36, Tissue.PARAHIPPOCAMPAL}

#: Subjects whose files are opened to find out a dataset's atlas, spread over the dataset.
_SAMPLE = 8

_Image = tuple[Path, str, bool]
"""File, hemisphere, and whether the file carries both."""


def _protocols(*, refused: bool = False) -> tuple[Protocol, ...]:
    """List the bundled protocols of ASHS's atlases: those with subfields, or those without."""
    return tuple(
        protocol
        for name in protocol_names()
        if (protocol := load_protocol(name)).tool == _TOOL and bool(protocol.refused) == refused
    )


def choose_atlas(request: scan.InputRequest) -> Protocol | None:
    """Take the atlas from ``--ashs-atlas``, if it is given."""
    if request.ashs_atlas is None:
        return None
    key = _plain(request.ashs_atlas)
    for protocol in (*_protocols(), *_protocols(refused=True)):
        if key in {_plain(protocol.name), _plain(protocol.name).removeprefix(_TOOL)}:
            return measurable(protocol)
    return load_protocol(request.ashs_atlas)


class AtlasFinder:
    """Identifies the atlas of each segmentation of one dataset.

    In this order: the option; a label table beside or above the file; the values, if only one
    atlas has such values; as one dataset is made with one atlas, the values of a sample of the
    dataset's files, if all of them that fit one atlas only fit the same one; and the first of
    several atlases by name, if the body is the same with all of them.
    """

    def __init__(self, root: Path, option: Protocol | None) -> None:
        self._root, self._option = root, option
        self._values: dict[_Image, frozenset[int]] = {}
        self._tables: dict[Path, Protocol] = {}

    def identify(self, image: _Image) -> tuple[Protocol, str, HipstaError | None]:
        """Identify one file's atlas: the protocol, why this one, and what is wrong."""
        if self._option is not None:
            return self._option, "atlas from --ashs-atlas", None
        try:
            table = find_table(image[0], self._root)
            if table is not None:
                return self._from_table(table), f"atlas from {table.name}", None
            return *self._from_values(image), None
        except (ProtocolError, InputError) as found:
            problem = self._without_subfields(image) or found
            unknown = scan.unknown_protocol(_TOOL, "ASHS, atlas not identified")
            return unknown, "atlas not identified", problem

    def _from_table(self, path: Path) -> Protocol:
        if path not in self._tables:
            rows = read_table(path)
            fitting = [protocol for protocol in _protocols() if agrees(protocol, rows)]
            self._tables[path] = (
                fitting[0] if _one_body(fitting) else table_protocol(path, "ashsCustom")
            )
        return self._tables[path]

    def _from_values(self, image: _Image) -> tuple[Protocol, str]:
        shared, count = self._shared
        if shared and image not in self._values:
            # Not opened here; reading it later will fail if its values do not fit.
            return shared[0], f"atlas from the labels of {_others(count)}{_or_another(shared)}"
        fitting = self._fitting(image)
        if len(fitting) == 1:
            return fitting[0], "only this atlas has such labels"
        left = [protocol for protocol in shared if protocol in fitting]
        if left and len(left) < len(fitting):
            fitting_text = "this one" if len(left) == 1 else _names(left)
            difference = f"those of {_others(count)} only {fitting_text}"
            return left[0], f"its labels fit {_names(fitting)}, {difference}{_or_another(left)}"
        if _one_body(fitting):
            return fitting[0], f"its labels fit {_names(fitting)}{_or_another(fitting)}"
        values = ", ".join(map(str, sorted(self._read(image))))
        if fitting:
            raise ProtocolError(
                f"{image[0]}: labels {values} fit {_names(fitting)}; "
                "say which atlas was used with --ashs-atlas",
                reason="ambiguous-atlas",
            )
        raise ProtocolError(
            f"{image[0]}: labels {values} fit no bundled ASHS atlas "
            f"({_names(list(_protocols()))}); describe them in a TOML file and give it to "
            "--ashs-atlas",
            reason="unknown-atlas",
        )

    @cached_property
    def _shared(self) -> tuple[list[Protocol], int]:
        """The atlases that the dataset can be of, and how many files of a sample prove it.

        Several only if the body is the same with all of them; none if the files disagree.
        """
        proofs: list[list[Protocol]] = []
        for image in _sample_files(self._root):
            try:
                fitting = self._fitting(image)
            except InputError:  # its own hemisphere will report it
                continue
            if _one_body(fitting):
                proofs.append(fitting)
        common = [p for p in proofs[0] if all(p in proof for proof in proofs)] if proofs else []
        return common, len(proofs)

    def _fitting(self, image: _Image) -> list[Protocol]:
        return [protocol for protocol in _protocols() if protocol.fits(self._read(image))]

    def _without_subfields(self, image: _Image) -> ProtocolError | None:
        """Recognize the labels of an atlas that has no subfields; it says what to do instead."""
        try:
            values = self._read(image)
        except InputError:
            return None
        path = image[0]
        for protocol in _protocols(refused=True):
            named = {label.code for label in protocol.labels if label.tissue in _ALWAYS}
            if named <= values and not self._fitting(image):
                return ProtocolError(f"{path}: {protocol.refused}", reason="no-subfields")
        return None

    def _read(self, image: _Image) -> frozenset[int]:
        """Read the codes of one hemisphere, in the range of the left one."""
        if image not in self._values:
            path, hemi, bilateral = image
            values = label_values(path)
            if bilateral:
                (offset,) = {protocol.right_offset for protocol in _protocols()}
                side_values = (v for v in values if (v > offset) == (hemi == "R"))
                values = frozenset(v - offset if hemi == "R" else v for v in side_values)
            self._values[image] = values
        return self._values[image]


def _plain(name: str) -> str:
    return re.sub("[^a-z0-9]", "", name.lower())


def _others(count: int) -> str:
    return f"{count} other file{'' if count == 1 else 's'} of the dataset"


def _names(protocols: list[Protocol]) -> str:
    *leading_names, last = (protocol.name for protocol in protocols)
    return f"{', '.join(leading_names)} and {last}" if leading_names else last


def _or_another(protocols: list[Protocol]) -> str:
    """Say what to do if several protocols with the same body are possible."""
    return "; the body is the same, --ashs-atlas names the other" if len(protocols) > 1 else ""


def _one_body(protocols: list[Protocol]) -> bool:
    """Check that there are protocols, and that all give the same body."""
    return bool(protocols) and all(protocols[0].same_body(other) for other in protocols[1:])


def volume_table(path: Path) -> Path | None:
    """Name the table of volumes that was written with a segmentation."""
    match = _NAME.fullmatch(path.name)
    return None if match is None else path.with_name(f"{match['stem']}_{match['kind']}_volumes.txt")


def find_ashs(
    visit: scan.VisitFolders, source: scan.Source, selection: Selection, atlases: AtlasFinder
) -> Iterator[scan.HemisphereInput]:
    """Find ASHS's segmentations of one visit."""
    all_files = _files(visit)
    for hemi in selection.wanted_hemis():
        files = [file for file in all_files if file.hemi in (hemi, None)]
        if not files:
            continue
        best = files[0]
        bilateral = best.hemi is None
        protocol, explanation, problem = atlases.identify((best.path, hemi, bilateral))
        if problem is None and bilateral and not protocol.offset:
            problem = InputError(
                f"{best.path}: neither left nor right is in its name, and the protocol "
                f"{protocol.name} does not say how the hemispheres differ; set right_offset in its "
                "TOML file",
                reason="unknown-hemisphere",
            )
        yield choose_file(
            files,
            visit,
            hemi,
            source,
            candidate=(protocol, problem),
            explanation=(_kind(best), f"; {explanation}"),
            passed_over=_passed_over(files),
        )


def _sample_files(root: Path) -> Iterator[_Image]:
    """List a sample of a dataset's segmentations, the same whoever is processed."""
    folders = scan.sort_folders(root)[0]
    step = max(len(folders) // _SAMPLE, 1)
    for visit in scan.list_visits(folders[::step]):
        files = _files(visit)
        for hemi in _SIDES.values():
            best = next((file for file in files if file.hemi in (hemi, None)), None)
            if best is not None:
                yield best.path, hemi, best.hemi is None


def _files(visit: scan.VisitFolders) -> list[SidedFile]:
    """List the segmentations of one visit, best first."""
    matches = (
        (folder.path / name, _NAME.fullmatch(name))
        for folder in visit.folders
        for name in folder.names
        if "lfseg" in name
    )
    files = []
    for path, match in matches:
        if match:
            hemi = _SIDES.get(match["stem"].rsplit("_", 1)[-1].lower())
            # One hemisphere before both, later steps before earlier, final before others.
            outside, other_id = path.parent.name != "final", f"sub-{visit.subject}" not in path.name
            rank = (hemi is None, _KINDS.index(match["kind"]), outside, other_id)
            files.append(SidedFile(path=path, hemi=hemi, rank=rank))
    return sorted(files, key=lambda file: (file.rank, str(file.path)))


def _kind(file: SidedFile) -> str:
    return _KINDS[file.rank[1]]


def _passed_over(files: list[SidedFile]) -> Iterator[tuple[str, str]]:
    best = files[0]
    for file in files[1:]:
        if file.hemi is None and best.hemi is not None:
            reason = "both hemispheres in one file; one file per hemisphere comes first"
        elif _kind(file) != _kind(best):
            reason = f"{_kind(best)} comes before {_kind(file)}"
        elif file.rank == best.rank:
            reason = "as good as the first one"
        else:
            reason = "files in final/ and with the subject's label come first"
        yield file.path.name, reason
