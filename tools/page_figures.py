"""Take the pictures of pages in docs/: the tutorial's cohort, and damaged labels.

.venv/bin/python tools/page_figures.py

Needs chromium on the PATH, and some minutes.
"""

import subprocess
import tempfile
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
from checks import hipsta

ROOT = Path(__file__).resolve().parents[1]
COHORT = ("--n-subjects", "24", "--thinning", "0.3", "--region", "CA1-anterior", "--seed", "1")
CA1 = 238  # FreeSurfer's code in the body
GAP = 4  # slices without labels
RADIUS = 8  # voxels, of the leak
CHROMIUM = (
    *("chromium", "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"),
    "--virtual-time-budget=5000",  # ms, for the scripts of the page
)


def change_labels(path: Path, how: str) -> None:
    """Interrupt the labels in the middle of the body, or let CA1 leak to lateral there."""
    image: Any = nib.load(path)
    codes = np.asarray(image.dataobj).copy()
    *_, slices = np.nonzero(codes == CA1)
    middle = int(np.median(slices))
    if how == "gap":
        codes[:, :, middle : middle + GAP] = 0
    else:
        x = int(np.nonzero(codes[:, :, middle] == CA1)[0].max())
        y = int(np.nonzero(codes[x, :, middle] == CA1)[0].mean())
        distance = np.indices(codes.shape) - np.reshape([x, y, middle], (3, 1, 1, 1))
        codes[(np.square(distance).sum(axis=0) < RADIUS**2) & (codes == 0)] = CA1
    nib.save(nib.MGHImage(codes.astype(np.int32), image.affine), path)


def take(picture: str, page: Path, height: int) -> None:
    """Save the top of a page, in a window of 1200 pixels."""
    options = [f"--window-size=1200,{height}", f"--screenshot={ROOT / 'docs' / picture}"]
    subprocess.run(  # noqa: S603  (ours)
        [*CHROMIUM, *options, page.as_uri()], check=True, capture_output=True
    )


def main() -> None:
    """Write the datasets, measure them, and take the pictures."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        hipsta("phantom", work / "cohort", *COHORT)
        hipsta(work / "cohort", work / "out", "participant")
        hipsta("phantom", work / "damaged", "--n-subjects", 2, "--seed", 2)
        labels = work / "damaged" / "derivatives" / "freesurfer"
        change_labels(labels / "sub-01" / "mri" / "lh.hippoAmygLabels-T1.v22.mgz", "gap")
        change_labels(labels / "sub-02" / "mri" / "lh.hippoAmygLabels-T1.v22.mgz", "leak")
        hipsta(work / "damaged", work / "faults", "participant", code=1)
        take("images/tutorial-report.png", work / "out" / "report.html", 1240)
        take("figures/reports/participant.png", work / "faults" / "sub-01.html", 960)
        take("figures/reports/look.png", work / "faults" / "sub-02.html", 960)


if __name__ == "__main__":
    main()
