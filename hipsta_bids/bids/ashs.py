"""ASHS's segmentations: ``*_{left,right}_lfseg_{corr_usegray,corr_nogray,heur}.nii.gz``.

They lie in ``final/`` below the subject's folder or directly in it. The part of the name that
ASHS takes for the subject's ID is often wrong; the folder decides. A file without ``left`` or
``right`` carries both hemispheres.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from hipsta_bids.bids.ashs_atlas import AtlasFinder
from hipsta_bids.bids.filters import Selection
from hipsta_bids.bids.inputs import HemisphereInput
from hipsta_bids.bids.scan import Visit, list_visits, subject_folders
from hipsta_bids.bids.sources import Source
from hipsta_bids.errors import HipstaError, InputError
from hipsta_bids.schemes import Scheme

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
    """Name the table of volumes that was written with a segmentation.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Path or None
        In the same folder, there or not; ``None`` if the file is not ASHS's.
    """
    match = _NAME.fullmatch(path.name)
    return None if match is None else path.with_name(f"{match['stem']}_{match['kind']}_volumes.txt")


def find_ashs(
    visit: Visit, source: Source, atlases: AtlasFinder, selection: Selection
) -> Iterator[HemisphereInput]:
    """Find ASHS's segmentations of one visit.

    Parameters
    ----------
    visit : Visit
    source : Source
    atlases : AtlasFinder
        Identifies the atlas.
    selection : Selection

    Yields
    ------
    HemisphereInput
        With ``problem`` set where several files are equally good, or the atlas is not certain.
    """
    everything = sorted(_files(visit), key=lambda file: (file.rank, str(file.path)))
    for hemi in selection.wanted_hemis():
        files = [file for file in everything if file.hemi in (hemi, None)]
        if not files:
            continue
        chosen = files[0]
        rivals = [file.path.name for file in files if file.rank == chosen.rank]
        scheme, why, problem = atlases.identify(chosen.path, hemi, bilateral=chosen.hemi is None)
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
            scheme=scheme,
            files=(chosen.path,),
            bilateral=bilateral,
            code_offset=scheme.right_offset if bilateral and hemi == "R" else 0,
            source=source.name,
            source_path=source.path,
            why=f"{chosen.kind}{', both hemispheres in one file' if bilateral else ''}; {why}",
            passed_over=tuple(_passed_over(files)),
            problem=problem or _without_offset(scheme, chosen),
        )


def sample_files(source: Source) -> Callable[[], list[tuple[Path, str, bool]]]:
    """Prepare a sample of a dataset's segmentations, the same whoever is processed.

    Parameters
    ----------
    source : Source

    Returns
    -------
    function
        Lists path, hemisphere, and whether the file carries both.
    """

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


def _without_offset(scheme: Scheme, file: _File) -> HipstaError | None:
    """Say what is wrong with a file of both hemispheres whose protocol knows no offset."""
    if file.hemi is not None or scheme.right_offset:
        return None
    return InputError(
        f"{file.path}: neither left nor right is in its name, and the protocol {scheme.name} "
        "does not say how the hemispheres differ; set right_offset in its TOML file",
        reason="unknown-hemisphere",
    )
