"""Commands that make every page and figure, on small data; shared by tests here and in images."""

import re
import shlex
from dataclasses import replace

import nibabel as nib
import numpy as np
import pandas as pd
from extension_marks import PRESENT
from norm_cohorts import write_people
from small_cohorts import (
    PLAN,
    place_of,
    read_participants,
    write_dataset,
    write_participants,
    write_sessions,
)

from hipsta_bids.derivatives.dataset import TABLES
from hipsta_bids.io import files
from hipsta_bids.phantom import Hemisphere, PhantomSpec
from hipsta_bids.phantom import write_dataset as write_phantoms
from validation.group import simulate_cohort

# Without an extension, its pages are not made.
CONSORTIA, AGREEMENT = "consortia" in PRESENT, "agreement" in PRESENT
SURROGATE = "surrogate" in PRESENT
#: Twelve of each group at each site, as many as summaries of sites take.
SITES = {"a": (*range(1, 13), *range(25, 37)), "b": (*range(13, 25), *range(37, 49))}
GROUP = "cohort/bids cohort/out group --settings quick.toml --align none --measures thickness"
PEOPLE = {site: " ".join(f"{i:02d}" for i in labels) for site, labels in SITES.items()}
MAPS = "labels/out/sub-02/anat/sub-02_hemi-L_seg-freesurfer"
TRIAL = "visits/bids visits/out group --align none --measures thickness"

#: Command, exit code, and the pages and figures that it makes, as patterns.
COMMANDS = [
    (
        "labels labels/out participant --settings coarse.toml --n-procs 1",
        1,  # one hemisphere is damaged
        ["labels/out/report.html", "labels/out/sub-02.html", "labels/out/sub-01_ses-[12].html"],
    ),
    *[
        (
            (
                "labels labels/shared participant --longitudinal --participant-label 01"
                " --settings coarse.toml --n-procs 1"
            ),
            0,
            ["labels/shared/report.html", "labels/shared/sub-01_ses-[12].html"],
        )
    ]
    * ("visits" in PRESENT),
    *[("surrogate labels labels/out --participant-label 02 --hemi L --settings coarse.toml", 0, [])]
    * SURROGATE,
    ("figure participant labels/out --participant-label 02 -o sheet.svg", 0, ["sheet.svg"]),
    # With tables of single slices beside the sheets, as after the command surrogate.
    (f"{GROUP} --name default", 0, ["cohort/out/group/default.html"]),
    (
        f"{GROUP} --name sides --asymmetry --no-classification"
        + " --normative group=CN" * ("norms" in PRESENT),
        0,
        ["cohort/out/group/sides.html"],
    ),
    *[
        (
            f"{GROUP} --name sites --covariates site.tsv --harmonize site --no-classification",
            0,
            ["cohort/out/group/sites.html"],
        )
    ]
    * ("sites" in PRESENT),
    *(
        (
            (
                f"{GROUP} --name {site} --no-classification"
                f"{f' --export-summary {site}' * CONSORTIA} --participant-label {PEOPLE[site]}"
            ),
            0,
            [f"cohort/out/group/{site}.html"],
        )
        for site in SITES
    ),
    *[
        (
            "meta cohort/out/group/a/summary.json cohort/out/group/b/summary.json meta",
            0,
            ["meta/meta.html", "meta/meta/figures/*.svg"],
        )
    ]
    * CONSORTIA,
    *[
        (
            "compare cohort/out/group/a cohort/out/group/b compared",
            0,
            ["compared.html", "compared/figures/*.svg"],
        )
    ]
    * AGREEMENT,
    (
        "figure contrast cohort/out --name default -o contrast.svg --measures thickness",
        0,
        ["contrast.svg"],
    ),
    *[
        (
            (
                f"correlate {MAPS}_thickness.shape.gii {MAPS}_curv.shape.gii correlated"
                f" --surface {MAPS}_midthickness.surf.gii --permutations 100"
            ),
            0,
            ["correlated/figures/*.svg"],
        )
    ]
    * AGREEMENT,
    *[
        (
            f"{TRIAL} --longitudinal --no-classification --settings quick.toml --name slopes",
            0,
            ["visits/out/group/slopes.html"],
        ),
        (
            f"{TRIAL} --paired 1 3 --no-classification --settings quick.toml --name pairs",
            0,
            ["visits/out/group/pairs.html"],
        ),
    ]
    * ("repeated" in PRESENT),
    *[
        (f"{TRIAL} --retest --name again", 0, ["visits/out/group/again.html"]),
        (f"{TRIAL} --power thinning=5% --name sizes", 0, ["visits/out/group/sizes.html"]),
    ]
    * ("trials" in PRESENT),
    *[
        (
            "norms/bids norms/out group --fit-norms --align none --measures volume --name norms",
            0,
            ["norms/out/group/norms.html"],
        ),
        (
            (
                "people/bids people/out group --norms norms/out/group/norms/norms.json"
                " --controls group=CN --measures volume --name scores"
            ),
            0,
            ["people/out/group/scores.html"],
        ),
    ]
    * ("norms" in PRESENT),
]


#: What pages, notes and warnings say where something is missing.
MISSING = re.compile(r"not made|could not be made|not drawn|TemplateNotFound|Traceback")


def words(command):
    return shlex.split(command)


def check_pages(folder, said, patterns):
    """Refuse output, pages and figures that say what is missing, or end early."""
    assert MISSING.findall(said) == [], said
    for pattern in patterns:
        paths = sorted(folder.glob(pattern))
        assert paths, pattern
        for path in paths:
            text = path.read_text(encoding="utf-8")
            assert MISSING.findall(text) == [], path
            assert text.rstrip().endswith(("</html>", "</svg>")), path


def write_inputs(folder):
    """Write what the commands read, for runs in this folder."""
    (folder / "coarse.toml").write_text("[grid]\nspacing = 0.5\n")
    (folder / "quick.toml").write_text("[classification]\nrepeats = 1\nfolds = 3\n")
    _write_labels(folder / "labels")
    _write_cohort(folder)
    random = np.random.default_rng(1)
    write_sessions(
        folder / "visits",
        simulate_cohort(replace(PLAN, sizes=(7, 7), effect=0.0), 0),
        0.03 + 0.02 * random.random(14),
        noise=0.03,
        column="age",
        times=lambda i, year: f"{60 + i + year}",
    )
    rows = [[f"sub-{i + 1:02d}", ("CN", "AD")[i % 2], "FM"[i // 2 % 2]] for i in range(14)]
    columns = ("participant_id", "group", "sex")
    write_participants(folder / "visits" / "bids", rows, columns)
    write_people(folder / "norms", {"A": 62, "B": 48}, 1)
    write_people(folder / "people", {"A": 6, "D": 26}, 2, cases=8)


def _write_labels(folder):
    """Two visits of a participant; a sound hemisphere with an image, and a damaged one."""
    hemispheres = [
        Hemisphere(subject=subject, hemi=hemi, spec=PhantomSpec(kind="spiral", length=8.0))
        for subject, hemi in (("01_ses-1", "L"), ("01_ses-2", "L"), ("02", "L"), ("02", "R"))
    ]
    write_phantoms(folder, hemispheres, voxel_size=(0.5, 0.5, 0.5))
    mri = folder / "derivatives" / "freesurfer" / "sub-02" / "mri"
    (left,), (right,) = mri.glob("lh.*"), mri.glob("rh.*")
    image = nib.load(left)
    gray = np.where(np.asarray(image.dataobj) > 0, 40, 120).astype(np.uint8)
    nib.save(nib.MGHImage(gray, image.affine), mri / "norm.mgz")
    right.write_bytes(right.read_bytes()[:1000])


def _write_cohort(folder):
    """Sheets of two groups at two sites, with thickness in a slice of each."""
    data, out = write_dataset(folder / "cohort", plan=replace(PLAN, sizes=(24, 24)))
    people = read_participants(data)
    write_participants(data, [[*row[:3], "FM"[i % 2]] for i, row in enumerate(people)])
    rows = [[f"sub-{i:02d}", site] for site, labels in SITES.items() for i in labels]
    files.write_tsv(folder / "site.tsv", ["participant_id", "site"], rows)
    if SURROGATE:
        _write_slices(out)


def _write_slices(out):
    columns = list(TABLES["surrogate"])
    for i in range(1, 49):
        values = 1.5 + 0.1 * np.random.default_rng(i).standard_normal(5)
        rows = [
            [".5", "proportional", n + 1, n / 4, 0, 0, 0, 0, value, value]
            for n, value in enumerate(values)
        ]
        path = place_of(out, f"{i:02d}", "L").path("surrogate")
        pd.DataFrame(rows, columns=columns).to_csv(path, sep="\t", index=False)
