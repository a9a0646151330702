"""What a person does about a hemisphere: read the verdict, rate it, open its files, correct it."""

import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hipsta_bids.derivatives.dataset import container_of_process
from hipsta_bids.derivatives.names import output_name, participant_report
from hipsta_bids.reports.cohort import Cohort
from hipsta_bids.reports.results import SURFACES, Hemisphere, Views, input_path
from hipsta_bids.reports.verdict import verdict_of

#: Colors of the edges of surfaces where FreeView cuts them, as in the slices of a page.
_EDGES = dict(zip(SURFACES, ("green", "white", "magenta"), strict=True))


#: What ITK-SNAP reads.
_NIFTI = (".nii", ".nii.gz")


def card_of(hemisphere: Hemisphere, cohort: Cohort, views: Views | None) -> Mapping[str, Any]:
    """Collect what the page says first about a hemisphere, and what leads on from there."""
    key, record = hemisphere.result.name.title, hemisphere.record
    order = [other.result.name.title for other in cohort.ranking]
    n = order.index(key) if key in order else None
    before = cohort.ranking[n - 1] if n else None
    after = cohort.ranking[n + 1] if n is not None and n + 1 < len(order) else None
    return {
        "key": key,
        "hash": record.get("input_hash") or "",
        "side": hemisphere.side,
        "status": str(hemisphere.status),
        "verdict": cohort.verdicts.get(key) or verdict_of(hemisphere),
        "findings": hemisphere.findings,
        "notes": record.get("notes") or [],
        "edited": [str(e.get("what")) for e in record.get("edited") or []],
        "neighbors": [
            ("previous", _link(before, cohort)),
            ("next", _link(after, cohort)),
        ],
        "commands": open_commands(
            hemisphere, views.anatomy.path if views and views.anatomy else None
        ),
    }


def _link(hemisphere: Hemisphere | None, cohort: Cohort) -> tuple[str, str] | None:
    """Address and words of a link to a hemisphere's part of its page."""
    if hemisphere is None:
        return None
    name = hemisphere.result.name
    title = name.title
    verdict = cohort.verdicts[title].title.lower()
    words = f"sub-{name.subject}{f' ses-{name.session}' if name.session else ''} {hemisphere.side}"
    if len({other.result.name.protocol for other in cohort.hemispheres}) > 1:
        words += " " + " ".join(filter(None, (name.seg, name.region_title)))
    return f"{participant_report(name.subject, name.session)}#{title}", f"{words}: {verdict}"


def open_commands(hemisphere: Hemisphere, anatomy: Path | None = None) -> list[tuple[str, str]]:
    """Write commands, by program, that open the files of a hemisphere from the output folder.

    In a container the folder with the labels is ``LABELS_DIR``, to be replaced.
    """
    result = hemisphere.result
    labels, mask = input_path(hemisphere), result.path("body_mask")
    volumes, behind = [], []
    if labels is not None and labels.exists():
        # Docker's own paths mean nothing outside; Apptainer's are those of the machine.
        hidden = container_of_process().get("Type") == "docker"
        address = f"LABELS_DIR/{labels.name}" if hidden else _from(result.root, labels)
        volumes.append((address, ":colormap=lut:opacity=0.5"))
        if anatomy is not None and not hidden:
            behind = [_from(result.root, anatomy)]
    if mask.exists():
        volumes.append((_from(result.root, mask), ":colormap=heat:opacity=0.3"))
    if not volumes:
        return []
    freeview = ["freeview", "-v", *behind, *(path + look for path, look in volumes)]
    surfaces = {name: result.path(f"{name}_surface") for name in SURFACES}
    if all(path.exists() for path in surfaces.values()):
        freeview.append("-f")
        freeview += [
            f"{_from(result.root, path)}:edgecolor={_EDGES[name]}"
            for name, path in surfaces.items()
        ]
    point = next((f.point for f in hemisphere.findings if f.point is not None), None)
    if point is not None:
        freeview += ["-ras", *(f"{value:g}" for value in point)]
    first, before = volumes[0][0], ""
    if not first.endswith(_NIFTI):
        before, first = f"mri_convert {shlex.quote(first)} labels.nii.gz && ", "labels.nii.gz"
    snap = ["itksnap", "-g", first]
    if len(volumes) > 1:
        snap += ["-s", volumes[1][0]]
    snap += [word for path in behind if path.endswith(_NIFTI) for word in ("-o", path)]
    return [("FreeView", shlex.join(freeview)), ("ITK-SNAP", before + shlex.join(snap))]


def _from(root: Path, path: Path) -> str:
    return Path(os.path.relpath(path, root)).as_posix()


def correction_of(hemispheres: Sequence[Hemisphere]) -> Mapping[str, Any]:
    """Name the files to correct, where they go, and the command that measures them again."""
    first = hemispheres[0].result.name
    choices = []
    for hemisphere in hemispheres:
        name = hemisphere.result.name
        mask = hemisphere.result.path("body_mask")
        by_mask = mask.exists() and name.region == "body"  # of other regions labels are corrected
        path = input_path(hemisphere)
        suffix = f"{name.title}_desc-edited"
        choices.append(
            {
                "side": hemisphere.side,
                "labels": path.name if path else None,
                "edited_labels": f"{suffix}_dseg.nii.gz",
                "mask": output_name(name, "body_mask") if by_mask else None,
                "edited_mask": f"{suffix}_mask.nii.gz",
            }
        )
    command = ["hipsta-bids", "BIDS_DIR", "OUT_DIR", "participant", "--edited-dir", "EDITS"]
    command += ["--participant-label", first.subject]
    command += ["--region", first.region] if first.region != "body" else []
    folder = f"EDITS/{first.folder}"
    return {"choices": choices, "folder": folder, "command": shlex.join(command)}
