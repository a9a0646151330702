"""ASHS's segmentations: ``*_{left,right}_lfseg_{corr_usegray,corr_nogray,heur}.nii.gz``.

They lie in ``final/`` below the subject's folder or directly in it. The part of the name that
ASHS takes for the subject's ID is often wrong; the folder decides. A file without ``left`` or
``right`` carries both hemispheres.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from hipsta_bids.errors import HipstaError, InputError, ProtocolError
from hipsta_bids.inputs.labels import label_values
from hipsta_bids.inputs.request import HemisphereInput, InputRequest
from hipsta_bids.inputs.scan import Selection, Source, Visit, list_visits, subject_folders
from hipsta_bids.inputs.tables import find_table, read_table
from hipsta_bids.protocols.load import agrees, load_protocol, protocol_from_names, protocol_names
from hipsta_bids.protocols.protocol import Protocol

# Which atlas an ASHS segmentation was made with: the same numbers mean different tissues.


_TOOL = "ashs"

#: Stands in where the atlas is not known: the hemisphere fails, but has a name in the outputs.
_UNKNOWN = Protocol(
    name=_TOOL,
    title="ASHS, atlas not identified",
    citation="",
    sheet=(),
    layer=(),
    interior=(),
    labels=(),
    tool=_TOOL,
)

_Sample = Callable[[], list[tuple[Path, str, bool]]]


def ashs_protocols() -> tuple[Protocol, ...]:
    """List the bundled protocols of ASHS's atlases."""
    return tuple(
        protocol for name in protocol_names() if (protocol := load_protocol(name)).tool == _TOOL
    )


def choose_atlas(request: InputRequest) -> Protocol | None:
    """Take the atlas from ``--ashs-atlas``, if it is given."""
    if request.ashs_atlas is None:
        return None
    key = _plain(request.ashs_atlas)
    for protocol in ashs_protocols():
        if key in {_plain(protocol.name), _plain(protocol.name).removeprefix(_TOOL)}:
            return protocol
    return load_protocol(request.ashs_atlas)


class AtlasFinder:
    """Identifies the atlas of each segmentation of one dataset.

    In this order: the option; a label table beside or above the file; the values, if only one
    atlas has such values; and, as one dataset is made with one atlas, the values of a sample of the
    dataset's files, if all of them that fit one atlas only fit the same one.
    """

    def __init__(self, root: Path, option: Protocol | None, sample: _Sample) -> None:
        self._root = root
        self._option = option
        self._sample = sample
        self._values: dict[tuple[Path, str], frozenset[int]] = {}
        self._tables: dict[Path, Protocol] = {}

    def identify(
        self, path: Path, hemi: str, *, bilateral: bool
    ) -> tuple[Protocol, str, HipstaError | None]:
        """Identify one file's atlas."""
        if self._option is not None:
            return self._option, "atlas from --ashs-atlas", None
        try:
            table = find_table(path, self._root)
            if table is not None:
                return self._from_table(table), f"atlas from {table.name}", None
            return *self._from_values(path, hemi, bilateral=bilateral), None
        except (ProtocolError, InputError) as problem:
            return _UNKNOWN, "atlas not identified", problem

    def _from_table(self, path: Path) -> Protocol:
        if path not in self._tables:
            rows = read_table(path)
            fitting = [protocol for protocol in ashs_protocols() if agrees(protocol, rows)]
            self._tables[path] = (
                fitting[0]
                if len(fitting) == 1
                else protocol_from_names(rows, name="ashsCustom", origin=path.name)
            )
        return self._tables[path]

    def _from_values(self, path: Path, hemi: str, *, bilateral: bool) -> tuple[Protocol, str]:
        shared = self._shared
        if shared is not None and (path, hemi) not in self._values:
            # Not opened here; reading it later will fail if its values do not fit.
            return shared[0], f"atlas from the labels of {_others(shared[1])}"
        fitting = self._fitting(path, hemi, bilateral=bilateral)
        if len(fitting) == 1:
            return fitting[0], "only this atlas has such labels"
        if shared is not None and shared[0] in fitting:
            others = f"those of {_others(shared[1])} only this one"
            return shared[0], f"its labels fit {_names(fitting)}, {others}"
        values = ", ".join(map(str, sorted(self._read(path, hemi, bilateral=bilateral))))
        if fitting:
            raise ProtocolError(
                f"{path}: labels {values} fit {_names(fitting)}; "
                "say which atlas was used with --ashs-atlas",
                reason="ambiguous-atlas",
            )
        raise ProtocolError(
            f"{path}: labels {values} fit no bundled ASHS atlas "
            f"({_names(list(ashs_protocols()))}); describe them in a TOML file and give it to "
            "--ashs-atlas",
            reason="unknown-atlas",
        )

    @cached_property
    def _shared(self) -> tuple[Protocol, int] | None:
        """The atlas of the dataset and how many files of a sample prove it."""
        proofs: list[Protocol] = []
        for path, hemi, bilateral in self._sample():
            try:
                fitting = self._fitting(path, hemi, bilateral=bilateral)
            except InputError:  # its own hemisphere will report it
                continue
            if len(fitting) == 1:
                proofs += fitting
        return (proofs[0], len(proofs)) if len(set(proofs)) == 1 else None

    def _fitting(self, path: Path, hemi: str, *, bilateral: bool) -> list[Protocol]:
        values = self._read(path, hemi, bilateral=bilateral)
        return [protocol for protocol in ashs_protocols() if protocol.fits(values)]

    def _read(self, path: Path, hemi: str, *, bilateral: bool) -> frozenset[int]:
        """Read the codes of one hemisphere, in the range of the left one."""
        if (path, hemi) not in self._values:
            values = label_values(path)
            if bilateral:
                (offset,) = {protocol.right_offset for protocol in ashs_protocols()}
                own = (v for v in values if (v > offset) == (hemi == "R"))
                values = frozenset(v - offset if hemi == "R" else v for v in own)
            self._values[path, hemi] = values
        return self._values[path, hemi]


def _plain(name: str) -> str:
    return re.sub("[^a-z0-9]", "", name.lower())


def _others(count: int) -> str:
    return f"{count} other file{'' if count == 1 else 's'} of the dataset"


def _names(protocols: list[Protocol]) -> str:
    return " and ".join(protocol.name for protocol in protocols)


_NAME = re.compile(r"(?P<stem>.*?)_?lfseg_(?P<kind>corr_usegray|corr_nogray|heur)\.nii(?:\.gz)?")
_SIDES = {"left": "L", "right": "R"}

#: ASHS's last step comes first.
_KINDS = ("corr_usegray", "corr_nogray", "heur")

#: Subjects whose files are opened to find out a dataset's atlas, spread over the dataset.
_SAMPLE = 8


@dataclass(frozen=True, kw_only=True)
class _File:
    path: Path
    hemi: str | None
    """None for both."""
    kind: str
    own_id: bool
    """The name agrees with the subject's folder."""

    @property
    def rank(self) -> tuple[bool, int, bool, bool]:
        """One hemisphere before both, later steps before earlier, ``final`` before others."""
        outside = self.path.parent.name != "final"
        return self.hemi is None, _KINDS.index(self.kind), outside, not self.own_id


def volume_table(path: Path) -> Path | None:
    """Name the table of volumes that was written with a segmentation."""
    match = _NAME.fullmatch(path.name)
    return None if match is None else path.with_name(f"{match['stem']}_{match['kind']}_volumes.txt")


def find_ashs(
    visit: Visit, source: Source, atlases: AtlasFinder, selection: Selection
) -> Iterator[HemisphereInput]:
    """Find ASHS's segmentations of one visit."""
    everything = sorted(_files(visit), key=lambda file: (file.rank, str(file.path)))
    for hemi in selection.wanted_hemis():
        files = [file for file in everything if file.hemi in (hemi, None)]
        if not files:
            continue
        chosen = files[0]
        rivals = [file.path.name for file in files if file.rank == chosen.rank]
        protocol, why, problem = atlases.identify(chosen.path, hemi, bilateral=chosen.hemi is None)
        if len(rivals) > 1:
            problem = InputError(
                f"{chosen.path.parent}: {' and '.join(rivals)} are equally good; "
                "keep one of them in the subject's folder",
                reason="several-files",
            )
        bilateral = chosen.hemi is None
        yield HemisphereInput(
            subject=visit.subject,
            session=visit.session,
            hemi=hemi,
            protocol=protocol,
            files=(chosen.path,),
            bilateral=bilateral,
            code_offset=protocol.right_offset if bilateral and hemi == "R" else 0,
            source=source.name,
            source_path=source.path,
            why=f"{chosen.kind}{', both hemispheres in one file' if bilateral else ''}; {why}",
            passed_over=tuple(_passed_over(files)),
            problem=problem or _without_offset(protocol, chosen),
        )


def sample_files(source: Source) -> Callable[[], list[tuple[Path, str, bool]]]:
    """Prepare a sample of a dataset's segmentations, the same whoever is processed."""

    def sample() -> list[tuple[Path, str, bool]]:
        folders = subject_folders(source.path)
        step = max(len(folders) // _SAMPLE, 1)
        found = []
        for visit in list_visits(folders[::step]):
            files = sorted(_files(visit), key=lambda file: (file.rank, str(file.path)))
            for hemi in _SIDES.values():
                best = next((file for file in files if file.hemi in (hemi, None)), None)
                if best is not None:
                    found.append((best.path, hemi, best.hemi is None))
        return found

    return sample


def _files(visit: Visit) -> Iterator[_File]:
    for folder in visit.folders:
        for name in folder.names:
            match = _NAME.fullmatch(name) if "lfseg" in name else None
            if match:
                side = match["stem"].rsplit("_", 1)[-1].lower()
                yield _File(
                    path=folder.path / name,
                    hemi=_SIDES.get(side),
                    kind=match["kind"],
                    own_id=f"sub-{visit.subject}" in name,
                )


def _passed_over(files: list[_File]) -> Iterator[tuple[str, str]]:
    chosen = files[0]
    for file in files[1:]:
        if file.hemi is None and chosen.hemi is not None:
            reason = "both hemispheres in one file; one file per hemisphere comes first"
        elif file.kind != chosen.kind:
            reason = f"{chosen.kind} comes before {file.kind}"
        elif file.rank == chosen.rank:
            reason = "as good as the first one"
        else:
            reason = "files in final/ and with the subject's label come first"
        yield file.path.name, reason


def _without_offset(protocol: Protocol, file: _File) -> HipstaError | None:
    """Say what is wrong with a file of both hemispheres whose protocol knows no offset."""
    if file.hemi is not None or protocol.right_offset:
        return None
    return InputError(
        f"{file.path}: neither left nor right is in its name, and the protocol {protocol.name} "
        "does not say how the hemispheres differ; set right_offset in its TOML file",
        reason="unknown-hemisphere",
    )
