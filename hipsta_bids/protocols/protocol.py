"""What segmentation protocols are made of: tissues, parts, labels; translation of their codes."""

import re
from enum import IntEnum
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, NonNegativeInt, PositiveInt, Strict

from hipsta_bids.errors import ProtocolError
from hipsta_bids.types.tables import TomlTable, did_you_mean


class Tissue(IntEnum):
    """What a voxel is. Values are internal; files of other tools never use them."""

    BACKGROUND = 0
    PRESUBICULUM = 1
    SUBICULUM = 2
    CA1 = 3
    CA2 = 4
    CA2_3 = 5  # CA2 and CA3 under one label
    CA3 = 6
    CA4 = 7
    DENTATE_GYRUS = 8  # also DG + CA4 (hilus) under one label
    MOLECULAR_LAYER = 9  # SRLM: strata radiatum, lacunosum, moleculare
    PARASUBICULUM = 10
    HATA = 11
    FIMBRIA = 12
    FISSURE = 13
    CYST = 14
    HIPPOCAMPUS = 15  # a head or tail label without subfields
    ENTORHINAL = 16
    BA35 = 17
    BA36 = 18
    PARAHIPPOCAMPAL = 19
    OTHER = 20  # named by the protocol, not used here (amygdala nuclei, ...)


class Part(IntEnum):
    """Where along the long axis a voxel lies, as far as its label has it."""

    UNKNOWN = 0
    HEAD = 1
    BODY = 2
    TAIL = 3


#: Subfields of the medial and of the lateral end of the sheet; CA1 lies between them.
MEDIAL_END: tuple[Tissue, ...] = (Tissue.PRESUBICULUM, Tissue.SUBICULUM)
LATERAL_END: tuple[Tissue, ...] = (Tissue.CA2, Tissue.CA2_3, Tissue.CA3)
#: What the sheet curls round.
CORE: tuple[Tissue, ...] = (Tissue.DENTATE_GYRUS, Tissue.CA4)

#: Order of the sheet's subfields from medial to lateral (Diers et al. 2023, section 2.1).
MEDIAL_TO_LATERAL: tuple[Tissue, ...] = (*MEDIAL_END, Tissue.CA1, *LATERAL_END)

#: Cortex that the sheet goes on into beyond its medial end, from far to near. The entorhinal cortex
#: lies before the parahippocampal cortex rather than next to it.
FAR_TO_NEAR: tuple[Tissue, ...] = (
    Tissue.BA36,
    Tissue.BA35,
    Tissue.ENTORHINAL,
    Tissue.PARAHIPPOCAMPAL,
    Tissue.PARASUBICULUM,
)

#: Rank along the sheet by tissue: that of the subfields is their value, which rises from medial to
#: lateral; cortex has 0 and less, the same where it lies side by side.
_RANKS = np.arange(max(Tissue) + 1, dtype=np.int8)
_RANKS[list(FAR_TO_NEAR)] = (-3, -2, -1, -1, 0)
_RANKS.flags.writeable = False

#: Tissues outside the hippocampal formation proper: they never decide where to crop.
OUTSIDE = frozenset({Tissue.BACKGROUND, Tissue.OTHER, *FAR_TO_NEAR}) - {Tissue.PARASUBICULUM}

#: How many codes an error message lists before it says how many more there are.
LISTED_CODES = 12


def _named(kind: type[IntEnum]) -> BeforeValidator:
    """Take a member of an enumeration, or its name in any case."""
    names = {member.name.lower(): member for member in kind}

    def find(value: object) -> object:
        name = str(value).lower()
        if isinstance(value, kind) or name in names:
            return names.get(name, value)
        raise ValueError(f"the name of a {kind.__name__.lower()}{did_you_mean(name, names)}")

    return BeforeValidator(find)


def _lower_color(value: str) -> str:
    if not re.fullmatch("#[0-9a-fA-F]{6}", value):
        raise ValueError("of the form #rrggbb")
    return value.lower()


TissueName = Annotated[Tissue, _named(Tissue)]
Tissues = Annotated[tuple[TissueName, ...], Strict(strict=False)]


class Label(TomlTable):
    """One code of a protocol; 0 is background."""

    code: PositiveInt
    tissue: TissueName
    part: Annotated[Part, _named(Part)] = Part.UNKNOWN
    name: str
    abbreviation: str
    color: Annotated[str, AfterValidator(_lower_color)]
    """``#rrggbb``, for pictures and label GIFTIs."""


class Protocol(TomlTable):
    """A segmentation protocol."""

    name: str
    """Letters and digits: it becomes the ``seg-`` entity of output names."""
    title: str
    citation: str
    sheet: Tissues
    """Tissues merged into the sheet, medial to lateral; empty where only parts are labeled."""
    layer: Tissues
    """Tissues whose voxels go to the nearest sheet tissue; what is left out here is no part of the
    sheet."""
    interior: Tissues
    """Tissues on the concave (interior) side of the sheet."""
    labels: Annotated[tuple[Label, ...], Strict(strict=False)]
    tool: str = ""
    """The software that writes these codes (``freesurfer``, ``ashs``, ``hippunfold``), if any."""
    unlisted: Literal["error", "other"] = "error"
    """What a code that is not listed means: ``error``, or ``other`` (outside the hippocampus)."""
    neighbors: Tissues = ()
    """Cortex beyond the medial end of the sheet, from far to near, for the regions with cortex."""
    right_offset: NonNegativeInt = 0
    """Added to right-hand codes in files that carry both hemispheres; 0 if there are none."""
    left_offset: NonNegativeInt = 0
    """The same for left-hand codes; one of the two is 0."""
    complete: bool = False
    """Refuse labels without some tissue of the sheet: where codes shift, that means others."""
    recognized_by: Tissues = ()
    """Tissues that have to occur, besides those of the sheet, in values that fit the protocol."""
    refused: str = ""
    """Why labels of this protocol cannot be measured, and what to use; empty if they can."""

    @property
    def codes(self) -> frozenset[int]:
        """All codes of the protocol, without the background."""
        return frozenset(label.code for label in self.labels)

    @property
    def offset(self) -> int:
        """The difference of the hemispheres' codes in files that carry both; 0 if there is none."""
        return max(self.left_offset, self.right_offset)

    def shift(self, hemi: str) -> int:
        """Return the number added to the codes of a hemisphere in files that carry both."""
        return self.left_offset if hemi == "L" else self.right_offset

    def same_body(self, protocol: "Protocol") -> bool:
        """Check whether codes that both protocols list give the same body."""
        first, second = ({label.code: label for label in p.labels} for p in (self, protocol))
        return (self.sheet, self.layer, self.interior) == (
            protocol.sheet,
            protocol.layer,
            protocol.interior,
        ) and all(
            (first[code].tissue, first[code].part) == (second[code].tissue, second[code].part)
            for code in first.keys() & second.keys()
        )

    def fits(self, values: frozenset[int]) -> bool:
        """Check whether the values of one hemisphere can be of this protocol.

        Every value has to be listed, and each tissue of the sheet, at least one of its interior and
        the ones that the protocol is recognized by have to occur.
        """
        if not self.sheet or not values <= self.codes:
            return False
        present = {label.tissue for label in self.labels if label.code in values}
        needed = {*self.sheet, *self.recognized_by}
        return needed <= present and not present.isdisjoint(self.interior)


def translate(
    codes: NDArray[np.integer], protocol: Protocol
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Translate the codes of a protocol into tissues and parts."""
    top = max(protocol.codes)
    # One row per code, and a last one that stands for every code outside the table.
    tissues = np.full(top + 2, Tissue.OTHER, dtype=np.uint8)
    parts = np.full(top + 2, Part.UNKNOWN, dtype=np.uint8)
    listed = np.zeros(top + 2, dtype=bool)
    tissues[0], listed[0] = Tissue.BACKGROUND, True
    for label in protocol.labels:
        tissues[label.code], parts[label.code] = label.tissue, label.part
        listed[label.code] = True

    rows = np.where((codes >= 0) & (codes <= top), codes, top + 1).astype(np.intp)
    occurs = np.bincount(rows.ravel(), minlength=top + 2) > 0
    if protocol.unlisted == "error" and (occurs & ~listed).any():
        unknown = np.unique(codes[~listed[rows]])
        raise ProtocolError(
            f"labels {_some(unknown)} are not in the protocol {protocol.name}; add them to a "
            "TOML copy and pass it with --scheme",
            reason="unknown-labels",
        )
    absent = [t.name for t in protocol.sheet if not (occurs & (tissues == t)).any()]
    if protocol.complete and absent:
        present = np.unique(codes[codes != 0])
        raise ProtocolError(
            f"no label of {', '.join(absent)} occurs (found {_some(present)}), which"
            f" {protocol.name} "
            "always has: another protocol was used",
            reason="wrong-scheme",
        )
    needed = np.isin(tissues, protocol.sheet) if protocol.sheet else parts != Part.UNKNOWN
    if not (occurs & needed).any():
        present = np.unique(codes[codes != 0])
        raise ProtocolError(
            f"no label of {'the sheet' if protocol.sheet else 'a part'} of {protocol.name} occurs "
            f"(found {_some(present)}): another protocol was used",
            reason="wrong-scheme",
        )
    return tissues[rows], parts[rows]


def _some(values: NDArray[np.integer]) -> str:
    """List the first few values."""
    suffix = f" and {len(values) - LISTED_CODES} more" if len(values) > LISTED_CODES else ""
    return ", ".join(str(value) for value in values[:LISTED_CODES].tolist()) + suffix


def lateral_rank(tissue: NDArray[np.uint8]) -> NDArray[np.int8]:
    """Rank from medial to lateral of the tissues of a sheet and of the cortex next to it."""
    return np.asarray(_RANKS[tissue])
