"""Norms at the command line: what is written, what travels, and what is refused."""

import json
import shutil

import nibabel as nib
import numpy as np
import pytest
from extension_marks import needs
from hippunfold_like import flat_surface, write_map, write_surface
from norm_cohorts import write_people
from pyarrow import parquet
from pydantic import ValidationError
from scipy import stats
from small_cohorts import NODES, place_of, read_participants, table, write_participants

from hipsta_bids.cli.main import main
from hipsta_bids.extensions.norms import norming
from hipsta_bids.extensions.norms.file import NormArrays, NormsFile, _digest, load_norms
from hipsta_bids.group.output.saved import templates_from_json
from hipsta_bids.group.output.tables import read_columns
from hipsta_bids.io import files
from hipsta_bids.reports.group import group_page
from hipsta_bids.stats.registration import mean_profiles, register_to
from hipsta_bids.stats.settings import RegistrationSettings

TABLE = ("participant_id", "group", "age", "sex", "site")
CONTROLS = ("--controls", "group=CN")


@pytest.fixture(autouse=True)
def _no_figures(request, monkeypatch):
    """Figures take longer than all else."""
    if "draws" not in request.node.name:
        monkeypatch.setattr(norming, "_figures", lambda *_: iter(()))


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ref")
    data, out = write_people(folder, {"A": 62, "B": 48}, 1)
    options = [
        "--fit-norms",
        "--measures",
        "thickness",
        "thickness_mean",
        "volume",
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(norming, "_figures", lambda *_: iter(()))
        assert main([str(data), str(out), "group", *options]) == 0
    return data, out


@pytest.fixture(scope="module")
def norms(reference):
    return reference[1] / "group" / "norms" / "norms.json"


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    """Some of site A, 26 controls and 8 patients of a new site D, and one who is too young."""
    data, out = write_people(tmp_path_factory.mktemp("new"), {"A": 6, "D": 26}, 2, cases=8)
    rows = read_participants(data)
    rows[0][2] = "4.0"
    write_participants(data, rows, TABLE)
    return data, out


def score(people, norms, *options):
    data, out = people
    assert main([str(data), str(out), "group", "--norms", str(norms), *options]) == 0
    return out / "group" / "scores"


@pytest.fixture(scope="module")
def scores(people, norms):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(norming, "_figures", lambda *_: iter(()))
        return score(people, norms, *CONTROLS)


def edited(norms, folder, **changes):
    """Norms with other entries, as if they had been written so."""
    content = json.loads(norms.read_text()) | changes
    path = folder / "edited.json"
    path.write_text(json.dumps(content | {"hash": _digest(content)}))
    return path


def refused(capsys, arguments, *said, code=65):
    assert main([str(one) for one in arguments]) == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    for text in said:
        assert text in lines[0]


def test_norms_hold_no_value_of_a_participant(reference, norms):
    text = norms.read_text()
    assert "sub-" not in text
    file, found = load_norms(norms)
    assert set(found) >= {("L", "thickness"), ("R", "thickness"), ("LR", "volume")}
    points = np.prod(NODES)
    assert found["L", "thickness"].mean.shape == (1 + 4 + 1, points)
    people = table(norms.parent / "covariates.tsv")
    assert file.participants == len(people) == sum(file.sites.values())
    excluded = table(norms.parent / "excluded.tsv")
    assert set(excluded.reason) == {"norms-age"}
    ages = table(reference[0] / "participants.tsv").age.sort_values().to_numpy()
    assert file.knots[0] == np.floor(ages[4])
    assert file.knots[-1] == np.ceil(ages[-5])


def test_tables_and_page_of_norms(norms):
    folder = norms.parent
    calibration = table(folder / "coverage.tsv").set_index(["measure", "hemi"])
    assert set(calibration.index.get_level_values(0)) == {"thickness", "thickness_mean", "volume"}
    assert calibration.loc["thickness"].below_5.between(0.03, 0.08).all()
    assert calibration.loc["thickness"].below_50.between(0.45, 0.55).all()
    # What was drawn is skewed.
    assert (calibration.loc["thickness"].transformed > 0.5).all()
    centiles = table(folder / "centiles.tsv").query("measure == 'volume' and hemi == 'L'")
    men, women = (centiles[centiles.sex == sex].p50.to_numpy() for sex in "MF")
    np.testing.assert_allclose(men - women, 30, atol=20)
    for name in ("coverage", "centiles"):
        columns = table(folder / f"{name}.tsv").columns.tolist()
        assert list(json.loads((folder / f"{name}.json").read_text())) == columns
        assert set(columns) <= set(read_columns("hipsta_bids.extensions.norms"))
    page = group_page(folder)
    assert "Calibration: percent below each centile" in page
    assert "could not be made" not in page
    text = (folder / "methods.md").read_text()
    assert "Jones MC, Pewsey A." in text
    assert "5-fold cross-validation" in text


def test_people_are_scored_and_a_new_site_by_its_controls(scores):
    summary = table(scores / "zscores.tsv").query("measure == 'volume' and hemi == 'L'")
    group = table(scores / "covariates.tsv").set_index("participant_id")
    z = summary.set_index("participant_id").z
    patients = group.index[group.group == "AD"]
    controls = group.index[(group.group == "CN") & (group.site == "D")]
    assert z[controls].mean() == pytest.approx(0, abs=0.05)
    assert z[controls].std() == pytest.approx(1, abs=0.12)
    assert z[patients].mean() < -1  # 60 mm³ of an SD of 25, or 37 of the sides' mean
    assert set(summary.participant_id[summary.adapted]) == set(controls)
    np.testing.assert_allclose(summary.centile, 100 * stats.norm.cdf(summary.z), atol=1e-6)
    regions = table(scores / "zscores.tsv").query("measure == 'thickness' and hemi == 'R'")
    assert set(regions.region) == {"all", "Sub", "CA1"}
    whole = regions[regions.region == "all"].set_index("participant_id")
    assert (whole.low[patients] > whole.low[controls].mean()).mean() > 0.7
    left_out = table(scores / "excluded.tsv")
    assert set(left_out.reason) == {"norms-age"}
    assert "sub-2000" in set(left_out.participant_id)
    assert not set(left_out.participant_id) & set(z.index)
    page = group_page(scores)
    assert "from controls group CN" in page
    assert "could not be made" not in page
    assert "controls group=CN: D (26)" in (scores / "methods.md").read_text()
    assert set(table(scores / "zscores.tsv").columns) <= set(
        read_columns("hipsta_bids.extensions.norms")
    )


def test_maps_of_scores_are_registered_to_the_norms(scores, people, norms):
    file, _ = load_norms(norms)
    image = nib.load(scores / "hemi-L_stat-z_desc-thickness_statmap.shape.gii")
    points = parquet.read_table(scores / "zscores.parquet").to_pandas().query("hemi == 'L'")
    written = np.array([one.data for one in image.darrays])
    np.testing.assert_allclose(written.ravel(), points.thickness_z, rtol=1e-6)
    names = table(people[0] / "participants.tsv").participant_id
    bends = np.array(
        [
            table(place_of(people[1], name[4:], "L").path("sheet")).curvature.to_numpy()
            for name in names
        ]
    ).reshape(-1, *NODES)
    template = templates_from_json(file.template, "")["L"]
    how = RegistrationSettings()
    warps = register_to(mean_profiles(bends, how), template, how).warps
    own = table(scores / "warps.tsv").query("hemi == 'L'")
    nodes = [f"node_{i + 1}" for i in range(NODES[0])]
    np.testing.assert_allclose(own[nodes], warps, atol=1e-6)


def test_norms_with_a_new_site_score_it_without_controls(scores, people, capsys):
    added = scores / "norms.json"
    kept = added.with_name("kept.json")
    shutil.copy(added, kept)
    before = table(scores / "zscores.tsv").query("measure == 'volume'").set_index("hemi")
    moved = kept.rename(people[0] / "with-D.json")
    after = table(score(people, moved, "--name", "scores") / "zscores.tsv")
    after = after.query("measure == 'volume'").set_index("hemi")
    np.testing.assert_allclose(after.z, before.z, atol=1e-6)
    assert not after.adapted.any()
    assert "were added" not in capsys.readouterr().out


def test_every_visit_is_scored_and_norms_take_first_ones(norms, tmp_path, capsys):
    data, out = write_people(tmp_path, {"A": 1, "D": 62}, 3, sessions=2)
    few = tmp_path / "group.toml"
    few.write_text("[norms]\nleast_participants = 50\n")
    call = [str(data), str(out), "group", "--measures", "volume", "--no-reports"]
    fit = ["--fit-norms", "--among", "site=D", "--settings", str(few), "--name", "few"]
    assert main([*call, *fit]) == 0
    assert "63 later sessions are not in the norms" in capsys.readouterr().out
    people = table(out / "group" / "few" / "covariates.tsv")
    assert load_norms(out / "group" / "few" / "norms.json")[0].sites == {"D": len(people)}
    score = [*call, "--norms", str(norms), *CONTROLS]
    assert main([*score, "--name", "same"]) == 0
    assert "age is equal in all sessions" in capsys.readouterr().out
    scores = table(out / "group" / "same" / "zscores.tsv")
    count = len(set(scores.participant_id))
    assert scores.groupby(["hemi", "session_id"]).size().unique().tolist() == [count]
    assert scores[scores.adapted].session_id.unique().tolist() == ["ses-1"]
    for name in table(data / "participants.tsv").participant_id:
        path = data / name / f"{name}_sessions.tsv"
        files.write_tsv(path, ["session_id", "age"], [["ses-1", "50"], ["ses-2", "70"]])
    assert main([*score, "--name", "aged"]) == 0
    assert "age is the same" not in capsys.readouterr().out
    gains = {}
    for name in ("same", "aged"):
        z = table(out / "group" / name / "zscores.tsv").query("hemi == 'L'")
        gains[name] = z[z.session_id == "ses-2"].z.mean() - z[z.session_id == "ses-1"].z.mean()
    # A volume is lower by 1 mm³ a year; controls who were all said to be 50 vary by 31 mm³.
    assert gains["aged"] == pytest.approx(gains["same"] + 20 / 31, abs=0.15)


def test_a_new_site_that_may_be_a_known_one_is_refused(people, norms, capsys, tmp_path):
    rows = [["a" if cell == "A" else cell for cell in row] for row in read_participants(people[0])]
    write_participants(tmp_path, rows, TABLE)
    call = [tmp_path, people[1], "group", "--norms", norms, *CONTROLS]
    refused(capsys, call, "norms: column site: a may be A; write it so")


def test_sites_need_controls(people, norms, capsys, tmp_path):
    call = [*people, "group", "--norms", norms]
    refused(capsys, call, "no norms of site 'D', only A, B", "needs 25 controls (--controls")
    few = tmp_path / "few.tsv"
    names = table(people[0] / "participants.tsv").query("site == 'D' and group == 'CN'")
    few.write_text("participant_id\n" + "\n".join(names.participant_id[:2]) + "\n")
    refused(
        capsys,
        [*call, *CONTROLS, "--exclude", few],
        "25 controls group=CN within the ages, and has 24",
    )
    refused(capsys, [*call, "--controls", "group=HC"], "--controls group=HC: no participant")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"seg": "other"}, "segmentation protocol: other, but here demo"),
        ({"region": "extended"}, "region: extended, but here body"),
        ({"settings_hash": "0"}, "hash of the participant level's settings: 0"),
        ({"x": [0.0, 1.0]}, "grid of the sheet: another grid, 2 by 7 nodes"),
    ],
)
def test_people_who_were_measured_in_another_way_are_refused(people, norms, capsys, change, said):
    other = edited(norms, people[0], **change)
    refused(capsys, [*people, "group", "--norms", other, *CONTROLS], said)


def test_measures_and_versions_are_compared(people, norms, capsys):
    call = [*people, "group", *CONTROLS]
    refused(capsys, [*call, "--norms", norms, "--measures", "curvature"], "no norms of curvature")
    other = edited(norms, people[0], versions=["0.0.1"])
    options = ["--measures", "volume", "--name", "other", "--no-reports"]
    assert main([str(one) for one in [*call, "--norms", other, *options]]) == 0
    assert "numbers may differ" in capsys.readouterr().out
    refused(capsys, [*call, "--norms", people[0] / "participants.tsv"], "JSON")


def test_unknown_sexes_and_people_without_a_row_are_named(people, norms, tmp_path, capsys):
    data, out = people
    rows = read_participants(data)
    sex = TABLE.index("sex")
    absent, unknown = rows[1][0], rows[2][0]
    rows[2][sex] = "unknown"
    write_participants(tmp_path, [rows[0], *rows[2:]], TABLE)
    options = ["--norms", str(norms), *CONTROLS, "--measures", "volume", "--name", "unknown"]
    assert main([str(tmp_path), str(out), "group", *options]) == 0
    assert "read as missing: sex 'unknown' (1)" in capsys.readouterr().out
    excluded = table(out / "group" / "unknown" / "excluded.tsv").set_index("participant_id")
    assert excluded.reason[[absent, unknown]].tolist() == ["incomplete"] * 2
    assert excluded.message[[absent, unknown]].tolist() == [
        "not in participants.tsv",
        "sex is missing",
    ]


def test_if_nobody_can_be_scored_it_says_why(people, norms, capsys):
    call = [*people, "group", "--norms", norms, "--participant-label", "2000"]
    refused(capsys, call, "no participant can be scored: outside of the norms' 2")


def test_small_references_are_refused(people, reference, capsys, tmp_path):
    refused(capsys, [*people, "group", "--fit-norms"], "40 participants", "100 are needed")
    one = [*people, "group", "--fit-norms", "--among", "group=AD"]
    refused(capsys, one, "8 participants", "100 are needed")
    rows = read_participants(reference[0])
    data = tmp_path / "bids"
    write_participants(data, [[*row[:4], "AC"[i > 98]] for i, row in enumerate(rows)], TABLE)
    small = [data, reference[1], "group", "--fit-norms"]
    refused(capsys, small, "too few participants at site C (8) (least 15)")
    unknown = [[*row[:3], row[3] if i > 20 else "n/a", row[4]] for i, row in enumerate(rows)]
    write_participants(data, unknown, TABLE)
    refused(capsys, small, "participants with age, sex and site, 100 are needed")
    write_participants(data, [[*row[:3], row[4], row[4]] for row in rows], TABLE)
    refused(capsys, small, "sex does not vary within site")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--controls", "group=CN"], "--controls: has no effect without --norms"),
        (["--fit-norms", "--controls", "group=CN"], "--controls: has no effect without --norms"),
        (["--norms", "x.json", "--align", "none"], "--align: has no effect with --norms"),
        (["--norms", "x.json", "--fit-norms"], "give one of --fit-norms, --norms"),
        (["--fit-norms", "--normative", "group=CN"], "--normative: has no effect"),
        (["--fit-norms", "--formula", "age"], "--formula: has no effect"),
    ],
)
def test_options_that_mean_nothing_together(people, capsys, options, said):
    refused(capsys, [*people, "group", *options], said, code=64)


def test_it_draws_charts_and_maps(people, norms):
    folder = score(
        people, norms, *CONTROLS, "--measures", "thickness", "volume", "--name", "scores"
    )
    names = {path.stem for path in (folder / "figures").iterdir()}
    assert names == {"volume_norms", "thickness_normmaps"}
    page = group_page(folder)
    assert "Volume: centiles by age" in page
    assert page.count("data:image/svg+xml") == 2


@needs("maps")
def test_maps_of_other_programs_without_sheets_or_sites(tmp_path, capsys):
    random = np.random.default_rng(0)
    points, triangles = flat_surface(12)
    data, out = tmp_path / "bids", tmp_path / "out"
    pattern = str(tmp_path / "maps" / "sub-{subject}_hemi-{hemi}.shape.gii")
    surface = tmp_path / "flat.surf.gii"
    write_surface(surface, points, triangles)
    rows = []
    for i in range(118):
        age = 20 + 60 * random.random()
        values = 2 - 0.01 * age + 0.1 * random.standard_normal(12) - 0.5 * (i > 115)
        write_map(tmp_path / "maps" / f"sub-{i:03d}_hemi-L.shape.gii", values)
        rows.append([f"sub-{i:03d}", "AD" if i > 115 else "CN", f"{age:.1f}"])
    write_participants(data, rows, TABLE[:3])
    options = ["--maps", f"wall={pattern}", "--maps-surface", str(surface)]
    call = [str(data), str(out), "group", *options]
    assert main([*call, "--fit-norms", "--among", "group=CN"]) == 0
    folder = out / "group" / "norms_CN"
    assert table(folder / "coverage.tsv").measure.tolist() == ["wall"]
    assert json.loads((folder / "norms.json").read_text())["sites"] == {"unnamed": 108}
    capsys.readouterr()
    assert main([*call, "--norms", str(folder / "norms.json"), "--among", "group=AD"]) == 0
    assert "no column 'site': all are taken to be at one, 'unnamed'" in capsys.readouterr().out
    found = table(out / "group" / "scores_AD" / "zscores.tsv")
    whole = found[found.region == "all"]
    assert whole.participant_id.tolist() == ["sub-116", "sub-117"]
    assert (whole.z < -3).all()
    assert "2 low, 0 high of 2</td>" in group_page(out / "group" / "scores_AD")


def test_counts_beyond_floats_are_refused():
    values = {name: [[0.1], [0.1]] for name in ("mean", "spread", "shape", "shift", "scale")}
    assert NormArrays.model_validate({**values, "n": [[7]]}).n == [[7]]
    with pytest.raises(ValidationError, match="less than or equal to 1000000000"):
        NormArrays.model_validate({**values, "n": [[10**400]]})


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("scales", r"norms\.L\.volume\.scales \(did you mean 'scale'\?\)"),
        ("x", r"volume\.x; known here: mean, spread, shape, shift, scale, n"),
    ],
)
def test_an_unknown_key_in_norms_of_a_measure_is_named(key, message):
    with pytest.raises(ValueError, match=message):
        files.checked_foreign({"norms": {"L": {"volume": {key: [[1.0]]}}}}, NormsFile)
