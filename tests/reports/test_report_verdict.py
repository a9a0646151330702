"""What a page says first: the finding that decides, and what it may do to the map."""

import csv
import json
import shutil

import numpy as np
import pytest

from hipsta_bids.reports.results import Hemisphere, find_results
from hipsta_bids.reports.verdict import RATINGS, consequences, verdict_of


def hemisphere(root, subject, hemi):
    return next(h for h in find_results(root, subject) if h.result.name.hemi == hemi)


def changed(found, **record):
    return Hemisphere(found.result, {**found.record, **record})


def flag(reason, message, share, change):
    return {
        "reason": reason,
        "message": message,
        "columns_share": share,
        "mean_change_mm": change,
    }


def test_each_status_has_its_verdict(out):
    verdicts = [verdict_of(hemisphere(out, *one)) for one in zip(("01", "01", "02", "02"), "LRLR")]  # noqa: B905
    assert [v.title for v in verdicts] == ["Use", "Use", "Look before use", "Do not use"]
    assert [v.kind for v in verdicts] == ["use", "use", "look", "refuse"]
    severity = [v.severity for v in verdicts]
    assert severity[0] == 0
    assert 0 < severity[1] < 1 <= severity[2] < severity[3] == 100
    assert "Fill missing slices" in verdicts[3].advice
    assert RATINGS[-1] == "exclude"


def table_of(found):
    """Read the sheet table without the package: columns by name, (Nx, Ny)."""
    with found.result.path("sheet").open() as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    shape = int(rows[-1]["x"]), int(rows[-1]["y"])
    numbers = {k: np.array([float(r[k]) for r in rows]).reshape(shape) for k in ("r", "a", "s")}
    numbers["thickness"] = np.array([float(r["thickness"]) for r in rows]).reshape(shape)
    repaired = np.array([r["repaired"] == "true" for r in rows]).reshape(shape)
    return numbers, repaired


def areas_of(points):
    """A quarter of every quadrilateral to each of its corners, by two triangles."""
    area = np.zeros(points.shape[:2])
    for i, j in np.ndindex(points.shape[0] - 1, points.shape[1] - 1):
        a, b, c, d = points[i, j], points[i + 1, j], points[i + 1, j + 1], points[i, j + 1]
        whole = 0.5 * np.linalg.norm(np.cross(c - a, d - b))
        for k in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)):
            area[k] += whole / 4
    return area


def smoothed(values, where):
    """Let marked values become the mean of their neighbors, again and again."""
    found, known = values.copy(), np.pad(np.ones(values.shape), 1)
    count = known[:-2, 1:-1] + known[2:, 1:-1] + known[1:-1, :-2] + known[1:-1, 2:]
    for _ in range(4000):
        wide = np.pad(found, 1)
        mean = (wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:]) / count
        found = np.where(where, mean, values)
    return found


def test_what_repairs_may_do_is_computed_from_the_table(out):
    found = hemisphere(out, "01", "R")
    numbers, repaired = table_of(found)
    assert repaired.any()
    thickness = numbers["thickness"]
    area = areas_of(np.stack([numbers[k] for k in "ras"], axis=-1))
    mean = np.average(thickness, weights=area)
    without = np.average(thickness[~repaired], weights=area[~repaired])
    other = np.average(smoothed(thickness, repaired), weights=area)
    share = area[repaired].sum() / area.sum()
    ((reason, consequence),) = consequences(found, 1.0)
    assert reason.startswith("Cut a bridge of 7 grid nodes at RAS")
    assert consequence.mean == pytest.approx(mean, abs=1e-6)
    assert consequence.mean == pytest.approx(found.summary["thickness_mean"], abs=1e-3)
    assert consequence.without == pytest.approx(without, abs=1e-6)
    assert consequence.smoothed == pytest.approx(other, abs=1e-5)
    assert consequence.share == pytest.approx(share, abs=1e-6)
    severity = verdict_of(found).severity
    assert severity == pytest.approx(abs(mean - other) * 100 * share, abs=0.006)
    text = verdict_of(found).consequence
    assert f"{share:.1%} of the map" in text
    assert f"{mean:.2f} mm as measured" in text
    assert f"{without:.2f} mm without them" in text


def test_the_largest_consequence_decides(out):
    found = hemisphere(out, "01", "L")
    mean = found.summary["thickness_mean"]
    flags = [
        flag("section-bump", "a bump near RAS 1 2 3 mm: look", 0.02, 0.3),
        flag("edge-notch", "a notch near RAS 1 2 3 mm: look; it concerns 20%", 0.2, -0.05),
        flag("folded", "folds: look", 0.5, None),
        flag("noisy-labels", "noise: look", None, None),
    ]
    verdict = verdict_of(changed(found, status="flagged", flags=flags))
    # 0.05 mm x 20 % of the map are more than 0.3 mm x 2 %.
    assert verdict.reason == "A notch near RAS 1 2 3 mm: look."
    assert verdict.consequence == (
        "The mean thickness could be 0.05 mm too small, and 20.0% of the map wrong:"
        f" {mean:.2f} mm as measured, {mean + 0.05:.2f} mm with these columns as those around them."
    )
    assert verdict.severity == 1.0
    flags[1]["mean_change_mm"] = -0.5
    assert verdict_of(changed(found, status="flagged", flags=flags)).severity == 10.0
    flags[1] |= {"columns_share": 1.0, "mean_change_mm": 2.0}
    assert verdict_of(changed(found, status="flagged", flags=flags)).severity == 99.0


def test_repairs_decide_where_they_weigh_more_than_flags(out):
    found = hemisphere(out, "01", "R")
    slight = [flag("section-bump", "a bump: look", 0.001, 0.001)]
    verdict = verdict_of(changed(found, status="flagged", flags=slight))
    assert verdict.reason.startswith("Cut a bridge")
    assert (verdict.title, verdict.severity) == ("Look before use", 1.0)


@pytest.mark.parametrize(
    ("reason", "share", "change", "text"),
    [
        ("noisy-labels", None, None, "What it does to the mean thickness is not known."),
        ("folded", 0.03, None, "It concerns 3.0% of the map; what it does to the mean"),
        ("subfield-missing", 1.0, None, "It concerns the whole map; what it does to the mean"),
        ("side-doubtful", 1.0, 0.0, "It concerns the whole map; the mean thickness hardly"),
        ("ends-uncertain", 0.0, 0.0, "No measured column lies there"),
        ("map-outside", None, None, "Thickness and shape do not depend on it."),
    ],
)
def test_what_is_not_known_is_said(out, reason, share, change, text):
    flags = [flag(reason, "doubtful", share, change)]
    verdict = verdict_of(changed(hemisphere(out, "01", "L"), status="flagged", flags=flags))
    assert verdict.consequence.startswith(text)
    assert (verdict.kind, verdict.severity) == ("look", 1.0)


def test_a_flag_without_numbers_is_measured_round_its_point(out):
    found = hemisphere(out, "02", "L")
    numbers, _ = table_of(found)
    points = np.stack([numbers[k] for k in "ras"], axis=-1)
    area, thickness = areas_of(points), numbers["thickness"]
    node = (20, 10)
    place = " ".join(f"{v:.3f}" for v in points[node])
    near = np.linalg.norm(points - np.round(points[node], 3), axis=-1) <= 1.5 + thickness / 2
    assert 0.01 < near.mean() < 0.5
    flags = [{"reason": "section-bump", "message": f"a bump near RAS {place} mm: look"}]
    ((_, consequence),) = consequences(changed(found, flags=flags, repairs=[]), 1.5)
    assert consequence.share == pytest.approx(area[near].sum() / area.sum(), abs=1e-6)
    without = np.average(thickness[~near], weights=area[~near])
    assert consequence.without == pytest.approx(without, abs=1e-6)


def test_a_table_that_is_gone_costs_the_numbers_only(out, tmp_path):
    copy = shutil.copytree(out, tmp_path / "copy")
    found = hemisphere(copy, "01", "R")
    found.result.path("sheet").unlink()
    verdict = verdict_of(found)
    assert verdict.title == "Use"
    assert verdict.consequence == "What it does to the mean thickness is not known."


def test_commands_open_the_files_from_the_output_folder(out):
    from hipsta_bids.reports.cohort import open_commands  # noqa: PLC0415

    (_, freeview), (_, snap) = open_commands(hemisphere(out, "01", "R"))
    words = freeview.split()
    assert words[:2] == ["freeview", "-v"]
    files = [word.split(":")[0] for word in words if ":" in word]
    assert len(files) == 5
    assert all((out / name).exists() for name in files)
    record = json.loads(hemisphere(out, "01", "R").result.path("qc").read_text())
    assert " ".join(words[words.index("-ras") + 1 :]) in record["repairs"][0]
    labels, mask = files[:2]
    assert snap == (f"mri_convert {labels} labels.nii.gz && itksnap -g labels.nii.gz -s {mask}")
    image = out.parent / "T2w.nii.gz"
    (_, freeview), (_, snap) = open_commands(hemisphere(out, "01", "R"), image)
    assert freeview.split()[2] == "../T2w.nii.gz"
    assert snap.endswith(f"-s {mask} -o ../T2w.nii.gz")


def test_commands_of_a_container_name_no_folder_of_it(out, monkeypatch):
    from hipsta_bids.reports.cohort import open_commands  # noqa: PLC0415

    monkeypatch.setenv("HIPSTA_BIDS_CONTAINER_TYPE", "docker")
    (_, freeview), (_, snap) = open_commands(hemisphere(out, "01", "R"))
    assert freeview.startswith("freeview -v LABELS_DIR/")
    assert snap.startswith("mri_convert LABELS_DIR/")
    monkeypatch.setenv("APPTAINER_CONTAINER", "image.sif")  # which sees the folders of the machine
    assert "LABELS_DIR" not in open_commands(hemisphere(out, "01", "R"))[0][1]


def test_of_several_repairs_the_largest_is_named(out):
    repairs = [
        "filled a cavity of 4 grid nodes at RAS 1 2 3 mm (CA1); it concerns 1.0% of the columns",
        "cut a bridge of 25 grid nodes at RAS 4 5 6 mm (CA1); it concerns 0.1% of the columns",
        "left out the uncus, 11 mm3 at RAS 7 8 9 mm",
    ]
    found = changed(hemisphere(out, "01", "R"), repairs=repairs)
    assert verdict_of(found).reason == (
        "3 repairs of the labels, the largest: cut a bridge of 25 grid nodes at RAS 4 5 6 mm (CA1)."
    )
