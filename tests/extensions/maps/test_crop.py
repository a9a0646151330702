"""HippUnfold's maps at the nodes of sheets: only the body, at the places of the sheet."""

from pathlib import Path

import numpy as np
import pytest
from hippunfold_like import PATTERNS, names, write_map, write_surface
from scipy import stats
from scipy.spatial import Delaunay
from small_cohorts import NODES, PLAN, methods_of, place_of, table, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.results import read_sheet
from hipsta_bids.extensions.maps.crop import crop_maps
from hipsta_bids.extensions.maps.external import find_maps, map_patterns
from hipsta_bids.inputs.maps import scan

#: One person, where the shared data are present.
HIPPUNFOLD = Path(__file__).parents[3] / ".." / "shared" / "data" / "hippunfold"

COUNT = sum(PLAN.sizes)
STEP = 0.4  # between vertices, mm
FAR = 9.0  # values of head and tail, mm: none may reach the body
#: Nodes are .5 mm apart from medial to lateral, and 2 mm along the body, whose ends are at 0 and 12
#: mm.
X, Y = 0.5 * np.arange(NODES[0]), 2.0 * np.arange(NODES[1])
BODY = np.stack([*np.meshgrid(X, Y, indexing="ij"), np.zeros(NODES)], axis=-1)


def bent(flat):
    """A sheet in scanner space, which is no plane."""
    r, a, _ = np.moveaxis(flat, -1, 0)
    return np.stack([r + 20, a - 30, 3 * np.sin(r / 4) + a / 5], axis=-1)


#: From 8 mm behind the body to 8 mm before it, and 1 mm wider than the sheet on both sides.
FLAT = np.stack(
    [*np.meshgrid(np.arange(-1, 11.01, STEP), np.arange(-8, 20.01, STEP), indexing="ij")], axis=-1
).reshape(-1, 2)
VERTICES = bent(np.column_stack([FLAT, np.zeros(len(FLAT))]))
TRIANGLES = Delaunay(FLAT).simplices
IN_BODY = (FLAT[:, 1] > -1.5) & (FLAT[:, 1] < 13.5)


def truth(subject, hemi, r, a):
    """Thickness at a place, mm: a slope along both axes, thinner in patients from lateral on."""
    patient = int(subject) > PLAN.sizes[0]
    noise = np.random.default_rng(int(subject) + 100 * (hemi == "R")).normal(0, 0.05)
    return 1.5 + 0.02 * r + 0.01 * a + noise - 0.3 * patient * (r > 5)


def write_hippunfold(root, subject, hemi, version, shift=0.0):
    path, flat_path = names(root / "hippunfold", subject, hemi, version=version)
    values = np.where(IN_BODY, truth(subject, hemi, *FLAT.T), FAR)
    write_map(path, values)
    write_surface(flat_path, np.column_stack([FLAT, np.zeros(len(FLAT))]), TRIANGLES)
    own = flat_path.with_name(flat_path.name.replace("space-unfold", "space-T1w"))
    write_surface(own, VERTICES + np.array([shift, 0, 0]), TRIANGLES)


def add_points(path):
    """Write the places of nodes into a sheet's table."""
    lines = path.read_text().splitlines()
    points = bent(BODY).reshape(-1, 3)
    rows = [f"{line}\t{r:.4f}\t{a:.4f}\t{s:.4f}" for line, (r, a, s) in zip(lines[1:], points)]  # noqa: B905  (the header is no point)
    path.write_text("\n".join([lines[0] + "\tr\ta\ts", *rows]) + "\n")


def subjects():
    return [f"{i + 1:02d}" for i in range(COUNT)]


@pytest.fixture(scope="module", params=[1, 2])
def cropped(request, tmp_path_factory):
    """Results of one analysis of both programs' maps; version 1 and version 2 of HippUnfold."""
    folder = tmp_path_factory.mktemp("crop")
    data, out = write_dataset(folder)
    for subject in subjects():
        for hemi in "LR":
            add_points(place_of(out, subject, hemi).path("sheet"))
            # The last participant's surface is in another space.
            away = 50.0 if subject == subjects()[-1] else 0.0
            write_hippunfold(data, subject, hemi, request.param, away)
    maps = ("--maps", f"hipp={PATTERNS[request.param]}", "--maps-crop", "--align", "none")
    options = ("--measures", "thickness", "hipp", "--no-classification", "--name", "both")
    assert main([str(data), str(out), "group", *maps, *options]) == 0
    return data, out


def test_values_are_those_at_the_nodes_of_the_body(cropped):
    means = table(cropped[1] / "group" / "both" / "means.tsv").query("measure == 'hipp'")
    for (hemi, group), rows in means.groupby(["hemi", "group"]):
        members = subjects()[: PLAN.sizes[0]] if group == "CN" else subjects()[PLAN.sizes[0] : -1]
        expected = np.mean([truth(one, hemi, *np.moveaxis(BODY, -1, 0)[:2]) for one in members], 0)
        assert (rows["n"] == len(members)).all()  # without the one in another space
        border = np.abs(BODY[..., 0] - 5) < STEP  # where patients' walls have a step
        found = rows["mean"].to_numpy().reshape(NODES)
        # Linear values between vertices that are less than STEP away.
        np.testing.assert_allclose(found[~border], expected[~border], atol=0.02 * STEP)


def test_effects_are_tested_on_the_grid_of_the_sheet(cropped):
    folder = cropped[1] / "group" / "both"
    for hemi in "LR":
        rows = table(folder / f"hemi-{hemi}_contrast-CNAD_desc-hipp_statmap.tsv")
        assert len(rows) == NODES[0] * NODES[1]
        thin = BODY[..., 0].ravel() > 5 + STEP
        assert rows["significant"][thin].all()
        np.testing.assert_allclose(rows["estimate"][thin], 0.3, atol=0.06)
    text = " ".join(methods_of(folder).split())
    assert "Maps of other programs (hipp) were sampled at the nodes of each participant's" in text
    notes = (folder / "analysis.json").read_text()
    assert "the surface reaches 0% of the sheet's nodes" in notes


def test_maps_of_both_programs_are_compared_at_the_same_places(cropped, tmp_path):
    folder = cropped[1] / "group" / "both"
    pair = [f"sheet={folder}:thickness", f"hippunfold={folder}:hipp"]
    assert main(["compare", *pair, str(tmp_path / "programs")]) == 0
    rows = table(tmp_path / "programs" / "agreement.tsv")
    for row in rows.query("contrast == 'CN-AD'").to_dict("records"):
        first, second = (
            table(folder / f"hemi-{row['hemi']}_contrast-CNAD_desc-{name}_statmap.tsv")["cohen_d"]
            for name in ("thickness", "hipp")
        )
        assert row["n_points"] == NODES[0] * NODES[1]
        assert row["r"] == pytest.approx(stats.pearsonr(first, second).statistic, abs=1e-6)


def test_refusals_name_surface_and_sheets(cropped, tmp_path, capsys):
    data, out = cropped
    pattern = "hippunfold/sub-{subject}/*/*_hemi-{hemi}*_thickness.shape.gii"
    options = ("--measures", "hipp", "--align", "none", "--no-reports", "--name", "x")
    crop = ("--maps", f"hipp={pattern}", "--maps-crop")
    for surface, text in (
        ("none/{subject}.surf.gii", "no surface in scanner space beside"),
        (f"{tmp_path}/small.surf.gii", "has 4 vertices, the map"),
    ):
        square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
        write_surface(tmp_path / "small.surf.gii", square, np.array([[0, 1, 2], [1, 2, 3]]))
        named = ("--maps-surface", surface)
        assert main([str(data), str(out), "group", *crop, *named, *options]) == 65
        assert text in capsys.readouterr().err
    assert main([str(data), str(tmp_path / "empty"), "group", *crop, *options]) == 64
    assert "there are no sheets" in capsys.readouterr().err


@pytest.mark.skipif(not HIPPUNFOLD.is_dir(), reason="shared data not found")
def test_real_maps_agree_with_the_sheet(tmp_path):
    """HippUnfold's surface lies beside the sheet, and both thicknesses go together."""
    arguments = [str(HIPPUNFOLD), str(tmp_path), "participant", "--hemi", "L", "--no-reports"]
    assert main(arguments) == 0
    pattern = "sub-{subject}/surf/*_hemi-{hemi}_*_label-hipp_thickness.shape.gii"
    (request,) = map_patterns([("hipp", pattern)], (), ())
    source = find_maps(
        request, HIPPUNFOLD, (), lambda *wanted: wanted[2] == "L", scan(request.pattern, HIPPUNFOLD)
    )
    place = place_of(tmp_path, "001", "L", seg="hippunfold")
    sides, _, notes = crop_maps(source, [("001", None)], {(("001", None), "L"): place})
    theirs = sides["L"].maps["hipp"][0]
    ours = read_sheet(place.path("sheet"), ("thickness",))["thickness"]
    assert not notes
    assert np.isfinite(theirs).all()
    # As in the suite hippunfold of the validation, whose limit is .5 for a person.
    assert np.corrcoef(theirs.ravel(), ours.ravel())[0, 1] > 0.5
    assert 1.2 < theirs.mean() < 1.9  # README of the data: 1.54 mm over the whole length
