"""Provenance of an output dataset in files of BIDS: which files and software made each result.

Names and keys follow the chapter "Provenance" proposed for the specification (BEP028): folder
``prov``, suffixes ``act``, ``ent`` and ``soft``.
"""

import hashlib
from pathlib import Path
from typing import Any

from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.names import DATASET_FILES, sources
from hipsta_bids.derivatives.results import ResultPlace, list_results, read_record
from hipsta_bids.errors import NothingToDoError
from hipsta_bids.io import files

#: Results that stand for a hemisphere; images name their sources in their sidecars.
_RESULTS = ("sheet", "summary", "qc")


def export_provenance(out_dir: Path, folder: Path) -> list[Path]:
    """Write activities, software and files of all measured hemispheres into ``folder/prov``.

    Commands have no paths: where data lie, and whose they are, is not recorded.
    """
    activities, entities, software = [], {}, {}
    for place in list_results(out_dir):
        record = read_record(place)
        version = str(record.get("version", ""))
        maker = f"bids::prov#{dataset.NAME}-{_unique(version)}"
        software[maker] = {"Id": maker, "Label": dataset.NAME, "Version": version}
        activity = _activity(place, record) | {"AssociatedWith": maker}
        activities.append(activity)
        for entry in (
            e for key in ("inputs", "edited", "probabilities") for e in record.get(key) or ()
        ):
            uri = str(entry["file"])
            entity = {"Id": uri, "Label": uri.rpartition("/")[2]}
            digest = {"Digest": {"sha256": entry["sha256"]}} if "sha256" in entry else {}
            entities[uri] = entity | digest
        for path in (place.path(key) for key in _RESULTS):
            if path.is_file():
                uri = f"bids::{path.relative_to(out_dir).as_posix()}"
                about = {"Id": uri, "Label": path.name, "GeneratedBy": activity["Id"]}
                entities[uri] = about
    if not activities:
        raise NothingToDoError(f"{out_dir}: no measured hemisphere; run the participant level")
    start = folder / "prov" / "prov-hipstabids"
    contents = {
        "act": {"Activities": activities},
        "ent": {"ProvEntities": list(entities.values())},
        "soft": {"Software": list(software.values())},
    }
    written = [Path(f"{start}_{suffix}.json") for suffix in contents]
    for path, content in zip(written, contents.values(), strict=True):
        files.write_json(path, content)
    return written


def _activity(place: ResultPlace, record: dict[str, Any]) -> dict[str, Any]:
    """Describe the measurement of one hemisphere."""
    name = place.name
    session = f" --session-label {name.session}" if name.session else ""
    region = "" if name.region == "body" else f" --region {name.region}"
    identity = [name.title, *(str(record.get(key)) for key in ("input_hash", "settings_hash"))]
    return {
        "Id": f"bids::prov#measure-{_unique(*identity, str(record.get('version')))}",
        "Label": f"Measurement of {name.title}",
        "Command": f"hipsta-bids BIDS_DIR OUT_DIR participant --participant-label {name.subject}"
        f"{session} --hemi {name.hemi}{region}",
        "Used": [*sources(record), f"bids::{DATASET_FILES['settings']}"],
    }


def _unique(*parts: str) -> str:
    """Return eight characters that differ where the parts do."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8]
