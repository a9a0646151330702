"""What finding the segmentations of many subjects costs: time, memory, and listings.

Writes a dataset of empty files with two sources for each subject, FreeSurfer's folders with as many
files as they have and HippUnfold's, and lists what would be processed::

    .venv/bin/python benchmarks/discovery.py [--n-subjects 5000] [--json FILE]

The second search finds the folders in the system's cache; on a network disk the first one counts.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from report import write_report

from hipsta_bids.inputs.scan import InputRequest
from hipsta_bids.inputs.search import dataset_notes, find_inputs, list_subjects
from hipsta_bids.participant.job import peak_memory
from hipsta_bids.participant.shard import Shard

_HIPPUNFOLD = "space-cropT1w_desc-subfields_atlas-multihist7_dseg.nii.gz"

#: Other files in FreeSurfer's mri folder.
_OTHER_FILES = 40


def write_stubs(root: Path, n_subjects: int) -> None:
    """Write empty files where segmentations would be."""
    for number in range(n_subjects):
        subject = f"sub-{number:06d}"
        (root / subject / "anat").mkdir(parents=True)
        mri = root / "derivatives" / "freesurfer" / subject / "mri"
        anat = root / "derivatives" / "hippunfold" / subject / "anat"
        for folder in (mri, anat):
            folder.mkdir(parents=True)
        for side, hemi in (("lh", "L"), ("rh", "R")):
            (mri / f"{side}.hippoAmygLabels-T1.v22.mgz").touch()
            name = (
                f"{subject}_hemi-{hemi}_space-cropT1w_desc-subfields_atlas-multihist7_dseg.nii.gz"
            )
            (anat / name).touch()
        for other in range(_OTHER_FILES):
            (mri / f"other-{other}.mgz").touch()


def search(root: Path) -> dict[str, Any]:
    """Find all inputs, and those of a hundredth."""
    request = InputRequest(bids_dir=root)
    start, cpu = time.perf_counter(), time.process_time()
    found = find_inputs(request)
    dataset_notes(request, found.items)
    whole, used = time.perf_counter() - start, time.process_time() - cpu
    start = time.perf_counter()
    part = Shard(index=1, count=100).take(list_subjects(request))
    n_part = len(find_inputs(InputRequest(bids_dir=root, participant_labels=part)).items)
    return {
        "hemispheres": len(found.items),
        "seconds": whole,
        "cpu_seconds": used,
        "memory_mb": peak_memory() / 1e6,
        "part": n_part,
        "part_seconds": time.perf_counter() - start,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--n-subjects", type=int, default=5000, metavar="N")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        write_stubs(Path(folder), options.n_subjects)
        runs = [search(Path(folder)) for _ in range(2)]
    for found in runs:
        print(
            "{hemispheres} inputs: {seconds:.1f} s, {cpu_seconds:.1f} CPU s, peak memory"
            " {memory_mb:.0f} MB; {part} of them: {part_seconds:.2f} s".format(**found)
        )
    if options.json:
        write_report(options.json, {"runs": runs})


if __name__ == "__main__":
    main()
