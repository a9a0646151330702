"""HippUnfold's segmentations: ``*_hemi-{L,R}_*desc-subfields*_dseg.nii.gz`` of versions 0 to 2.

The order of entities differs between versions. See "Output Files" in HippUnfold's documentation.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hipsta_bids.errors import HipstaError, InputError, ProtocolError
from hipsta_bids.inputs.scan import HemisphereInput, Selection, Source, VisitFolders
from hipsta_bids.io.files import entities
from hipsta_bids.protocols.load import load_protocol

_TOOL = "hippunfold"

#: Atlases with the bundled protocol's codes, best first; None is version 0, which had one atlas.
_ATLASES = ("multihist7", "bigbrain", None)

_IMAGES = {".nii.gz", ".nii"}


@dataclass(frozen=True, kw_only=True)
class _File:
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


def is_hippunfold(name: str, source: Source) -> bool:
    """Check whether a file is HippUnfold's segmentation of hippocampal subfields."""
    if "desc-subfields" not in name or "_hemi-" not in name:
        return False
    if source.generators and "hippunfold" not in source.generators:
        return False
    pairs = entities(name)
    return (
        pairs["suffix"] == "dseg"
        and pairs["extension"] in _IMAGES
        and pairs.get("desc") == "subfields"
        and pairs.get("label", "hipp") == "hipp"
    )


def find_hippunfold(
    visit: VisitFolders, source: Source, selection: Selection
) -> Iterator[HemisphereInput]:
    """Find HippUnfold's segmentations of one visit.

    ``space-crop*`` comes first (the finest grid in the subject's own space), then the image's own
    grid. Files in coronal-oblique and template spaces may be scaled, and are not used.
    """
    for hemi in selection.wanted_hemis():
        files = sorted(_files(visit, hemi, source, selection), key=lambda file: file.rank)
        if not files:
            continue
        chosen = files[0]
        known = chosen.atlas in _ATLASES
        users = selection.protocol if not known and selection.describes(_TOOL) else None
        note = "labels on the image's own grid, which may be coarse; no space-crop* file exists"
        yield HemisphereInput(
            subject=visit.subject,
            session=visit.session,
            hemi=hemi,
            protocol=users or load_protocol("hippunfold"),
            files=(chosen.path,),
            source=source.name,
            source_path=source.path,
            why=f"space {chosen.space or 'not named'}, atlas {chosen.atlas or 'not named'}",
            passed_over=tuple((file.path.name, _reason(file, chosen)) for file in files[1:]),
            problem=_problem(chosen, known=known or users is not None),
            notes=() if chosen.cropped else (note,),
        )


def _files(visit: VisitFolders, hemi: str, source: Source, selection: Selection) -> Iterator[_File]:
    for folder in visit.folders:
        for name in folder.names:
            if not is_hippunfold(name, source):
                continue
            pairs = entities(name)
            path = folder.path / name
            if pairs["hemi"] == hemi and selection.wants_file(path):
                yield _File(path=path, space=pairs.get("space", ""), atlas=pairs.get("atlas"))


def _reason(file: _File, chosen: _File) -> str:
    if file.scaled:
        return f"space {file.space} may be scaled, which changes thickness"
    if file.atlas != chosen.atlas:
        return f"atlas {chosen.atlas} comes first; a --bids-filter-file selects another one"
    if chosen.cropped and not file.cropped:
        return f"coarser grid than space {chosen.space}"
    return "as good as the first one; a --bids-filter-file selects it"


def _problem(file: _File, *, known: bool) -> HipstaError | None:
    if file.scaled:
        return InputError(
            f"{file.path}: space {file.space} may be scaled, which changes thickness; "
            "run HippUnfold with its default output space",
            reason="template-space",
        )
    if not known:
        return ProtocolError(
            f"{file.path}: no bundled protocol for HippUnfold's atlas {file.atlas}; "
            "describe its labels in a TOML file and pass it with --scheme",
            reason="unknown-atlas",
        )
    return None
