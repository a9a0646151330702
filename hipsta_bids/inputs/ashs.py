"""Which atlas ASHS's segmentations were made with: atlases use the same codes for other regions."""

import re
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from pathlib import Path

from hipsta_bids.errors import HipstaError, InputError, ProtocolError
from hipsta_bids.inputs import scan
from hipsta_bids.inputs.generic import find_table, read_table, table_protocol
from hipsta_bids.inputs.labels import label_values
from hipsta_bids.inputs.selection import LabelFile, Verdict, measurable
from hipsta_bids.protocols.load import agrees, load_protocol, protocol_names
from hipsta_bids.protocols.protocol import Protocol, Tissue

_TOOL = "ashs"

#: Tissues that an atlas without subfields labels in everyone.
_ALWAYS = {Tissue.HIPPOCAMPUS, Tissue.ENTORHINAL, Tissue.BA35, Tissue.BA36, Tissue.PARAHIPPOCAMPAL}

Image = tuple[Path, str, bool]
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

    In this order: the option; a label table near or above the file; the values, if only one atlas
    has them; as one dataset is made with one atlas, the values of a sample of the dataset's files,
    if all of them that fit one atlas only fit the same one; and the first of several atlases by
    name, if the body is the same with all of them.
    """

    def __init__(
        self, root: Path, option: Protocol | None, sample: Callable[[], Iterable[Image]]
    ) -> None:
        self._root, self._option, self._sample = root, option, sample
        self._values: dict[Image, frozenset[int]] = {}
        self._tables: dict[Path, Protocol] = {}

    def identify(self, file: LabelFile, hemi: str) -> Verdict:
        """Identify one file's atlas; a file of both hemispheres needs one with both sides."""
        image = (file.path, hemi, file.hemi is None)
        problem: HipstaError | None = None
        try:
            protocol, explanation = self._atlas_of(image)
            if file.hemi is None and not protocol.offset:
                problem = InputError(
                    f"{file.path}: the name has no side, and labels of {protocol.name} have "
                    "none; set right_offset in its TOML file",
                    reason="unknown-hemisphere",
                )
        except (ProtocolError, InputError) as error:
            protocol = scan.unknown_protocol(_TOOL, "ASHS, atlas not identified")
            explanation, problem = "atlas not identified", self._without_subfields(image) or error
        return Verdict(
            protocol=protocol,
            explanation=f"{file.traits['kind']}{file.remark}; {explanation}",
            problem=problem,
            provenance={"atlas": protocol.name},
        )

    def _atlas_of(self, image: Image) -> tuple[Protocol, str]:
        if self._option is not None:
            return self._option, "atlas from --ashs-atlas"
        if table := find_table(image[0], self._root):
            return self._from_table(table), f"atlas from {table.name}"
        return self._from_values(image)

    def _from_table(self, path: Path) -> Protocol:
        if path not in self._tables:
            rows = read_table(path)
            fitting = [protocol for protocol in _protocols() if agrees(protocol, rows)]
            self._tables[path] = (
                fitting[0] if _one_body(fitting) else table_protocol(path, "ashsCustom")
            )
        return self._tables[path]

    def _from_values(self, image: Image) -> tuple[Protocol, str]:
        shared, count = self._shared
        rest_text = f"{count} other file{'' if count == 1 else 's'} of the dataset"
        if shared and image not in self._values:
            # Not opened here; reading it later will fail if its values do not fit.
            return _first(shared, f"atlas from the labels of {rest_text}")
        fitting = self._fitting(image)
        if len(fitting) == 1:
            return fitting[0], "only this atlas has labels like these"
        left = [protocol for protocol in shared if protocol in fitting]
        if left and len(left) < len(fitting):
            choice = "this one" if len(left) == 1 else _names(left)
            return _first(
                left, f"its labels fit {_names(fitting)}; labels of {rest_text} fit only {choice}"
            )
        if _one_body(fitting):
            return _first(fitting, f"its labels fit {_names(fitting)}")
        values = ", ".join(map(str, sorted(self._read(image))))
        text = (
            f"{_names(fitting)}; name the atlas with --ashs-atlas"
            if fitting
            else (
                f"no bundled ASHS atlas ({_names(_protocols())}); "
                "describe them in a TOML file and give it to --ashs-atlas"
            )
        )
        reason = "ambiguous-atlas" if fitting else "unknown-atlas"
        raise ProtocolError(f"{image[0]}: labels {values} fit {text}", reason=reason)

    @cached_property
    def _shared(self) -> tuple[list[Protocol], int]:
        """The atlases that the dataset can be of, and how many files of a sample prove it.

        Several only if the body is the same with all of them; none if the files disagree.
        """
        proofs: list[list[Protocol]] = []
        for image in self._sample():
            try:
                fitting = self._fitting(image)
            except InputError:  # its hemisphere will report it
                continue
            if _one_body(fitting):
                proofs.append(fitting)
        common = [p for p in proofs[0] if all(p in proof for proof in proofs)] if proofs else []
        return common, len(proofs)

    def _fitting(self, image: Image) -> list[Protocol]:
        return [protocol for protocol in _protocols() if protocol.fits(self._read(image))]

    def _without_subfields(self, image: Image) -> ProtocolError | None:
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

    def _read(self, image: Image) -> frozenset[int]:
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


def _names(protocols: Sequence[Protocol]) -> str:
    *leading_names, last = (protocol.name for protocol in protocols)
    return f"{', '.join(leading_names)} and {last}" if leading_names else last


def _first(protocols: Sequence[Protocol], text: str) -> tuple[Protocol, str]:
    """Take the first of the protocols that are possible, all with the same body."""
    text += "; the body is the same, --ashs-atlas names the other" if len(protocols) > 1 else ""
    return protocols[0], text


def _one_body(protocols: list[Protocol]) -> bool:
    """Check that there are protocols, and that all give the same body."""
    return bool(protocols) and all(protocols[0].same_body(protocol) for protocol in protocols[1:])
