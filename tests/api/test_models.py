"""The models on arrays: ``hipsta_bids.group``."""

import json

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from small_cohorts import read_participants, write_dataset, write_participants
from statsmodels.regression.linear_model import OLS
from statsmodels.stats.multitest import multipletests

import hipsta_bids as hb
import hipsta_bids.group.output.write
import hipsta_bids.group.settings
import hipsta_bids.stats.glm
from hipsta_bids.cli.main import main
from hipsta_bids.errors import ModelError

N, SHAPE = 24, (6, 5)
RANDOM = np.random.default_rng(3)
TABLE = pd.DataFrame(
    {
        "participant_id": [f"sub-{i:02d}" for i in range(N)],
        "group": ["CN", "MCI", "AD"] * (N // 3),
        "age": RANDOM.normal(70, 6, N),
    }
)
MAPS = {side: RANDOM.normal(2.0, 0.2, (N, *SHAPE)) for side in "LR"}
MAPS["L"][TABLE.group == "AD", :3] -= 0.4
MAPS["L"][0, 0, 0] = np.nan
LABELED = xr.DataArray(
    np.stack([MAPS["L"], MAPS["R"]], axis=1)[:, None],
    dims=("participant", "session", "side", "x", "y"),
    coords={"participant": TABLE.participant_id, "side": ["L", "R"], "x": np.linspace(-1, 1, 6)},
    name="thickness",
    attrs={"units": "mm"},
)


def test_the_folder_of_that_name_stays_a_package():
    assert hb.group is hipsta_bids.group
    assert callable(hb.group)
    assert hipsta_bids.stats.glm.fit_points is not None


def test_statistics_are_those_of_statsmodels():
    fit = hb.group(MAPS, TABLE, "group + age", contrasts=["older = age"])
    design = np.column_stack(
        [np.ones(N), TABLE.group == "AD", TABLE.group == "MCI", TABLE.age]
    ).astype(float)
    own = {name: values[0, 0] for name, values in fit.maps.items()}
    for x, y in ((0, 0), (2, 3), (5, 4)):
        values = MAPS["L"][:, x, y]
        known = np.isfinite(values)
        expected = OLS(values[known], design[known]).fit()
        assert own["estimate"][x, y] == pytest.approx(expected.params[3])
        assert own["se"][x, y] == pytest.approx(expected.bse[3])
        assert own["p"][x, y] == pytest.approx(expected.pvalues[3])
        assert own["df"][x, y] == known.sum() - 4
    adjusted = multipletests(own["p"].ravel(), 0.05, "fdr_tsbky")[1]
    np.testing.assert_allclose(own["p_corrected"].ravel(), adjusted)


def test_groups_are_compared_with_their_reference():
    fit = hb.group(MAPS, TABLE, "group + age")
    assert fit.contrasts == ("CN-AD", "CN-MCI")
    assert fit.sides == ("L", "R")
    assert fit.significant.shape == (2, 2, *SHAPE)
    assert fit.significant[0, 0, :3].mean() > 0.8
    other = hb.group(MAPS, TABLE, "group + age", references={"group": "AD"})
    np.testing.assert_allclose(
        other.maps["estimate"][:, other.contrasts.index("AD-CN")], -fit.maps["estimate"][:, 0]
    )
    row = fit.table.iloc[0]
    assert (row.side, row.contrast, row.test, row.participants, row.points) == (
        "L", "CN-AD", "t", N, 30,
    )  # fmt: skip
    assert row.significant == fit.significant[0, 0].sum()
    assert row.largest_effect == np.nanmax(fit.maps["effect"][0, 0])


def test_rows_are_found_by_participant():
    shuffled = TABLE.sample(frac=1.0, random_state=1)
    expected = hb.group(MAPS, TABLE, "group + age")
    found = hb.group(LABELED, shuffled, "group + age")
    for name, values in expected.maps.items():
        np.testing.assert_allclose(found.maps[name], values)
    fewer = hb.group(LABELED, shuffled[shuffled.participant_id != "sub-05"], "group + age")
    assert [len(names) for names in fewer.design.dropped.values()] == [1]
    assert fewer.table.participants.tolist() == [N - 1] * 4


def test_dataset_has_coordinates_and_units():
    found = hb.group(LABELED.sel(side=["R"]), TABLE, "age").dataset
    assert dict(found.sizes) == {"side": 1, "contrast": 1, "x": 6, "y": 5}
    assert found.side.item() == "R"
    assert found.contrast.item() == "age"
    assert found.attrs["measure"] == "thickness"
    assert (found.estimate.attrs["units"], found.p.attrs["units"]) == ("mm", "1")
    np.testing.assert_array_equal(found.x, LABELED.x)


def test_vertices_are_tested_like_points_of_a_sheet():
    flat = MAPS["L"].reshape(N, -1)
    found = hb.group(flat, TABLE, "group + age")
    expected = hb.group(MAPS["L"], TABLE, "group + age")
    np.testing.assert_array_equal(found.maps["p"][0], expected.maps["p"].reshape(2, -1))
    assert dict(found.dataset.sizes) == {"side": 1, "contrast": 2, "vertex": 30}


def test_permutations_take_the_neighbors_that_are_given():
    table = TABLE.assign(group=np.where(TABLE.group == "AD", "AD", "CN"))
    settings = hipsta_bids.group.settings.GroupSettings().changed(
        multiplicity={"permutations": 200}
    )
    more = {"correction": "permutation-tfce", "settings": settings}
    sheet = hb.group(MAPS["L"], table, "group", **more)
    assert sheet.significant[0, 0, :3].mean() > 0.8
    assert not sheet.significant[0, 0, 4:].any()
    flat = MAPS["L"].reshape(N, -1)
    with pytest.raises(ValueError, match="triangles"):
        hb.group(flat, table, "group", **more)
    node = np.arange(30).reshape(SHAPE)
    corners = [node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]]
    a, b, c, d = (corner.ravel() for corner in corners)
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    mesh = hb.group(flat, table, "group", triangles=faces, **more)
    # Diagonals count as neighbors on a sheet, and only half of them do here.
    np.testing.assert_allclose(
        mesh.maps["p_corrected"].ravel(), sheet.maps["p_corrected"].ravel(), atol=0.15
    )
    assert mesh.significant[0, 0, :15].mean() > 0.8


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        (MAPS["L"][1:], "23 maps of side both, 24 rows"),
        (MAPS["L"][0, 0, 0], r"shape \(\)"),
        ({"L": MAPS["L"], "R": MAPS["R"][:, 1:]}, "same points"),
        (LABELED.rename(participant="subject"), "need participant"),
        (xr.concat([LABELED, LABELED], "session"), "one session"),
    ],
)
def test_maps_that_do_not_fit_are_refused(maps, message):
    with pytest.raises(ValueError, match=message):
        hb.group(maps, TABLE, "age")


def test_wrong_models_are_refused():
    with pytest.raises(ModelError, match="ages"):
        hb.group(MAPS, TABLE, "group + ages")
    with pytest.raises(ValueError, match="occurs twice"):
        hb.group(LABELED, pd.concat([TABLE, TABLE]), "age")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A cohort of two small hemispheres a participant, with more columns than it needs."""
    data, out = write_dataset(tmp_path_factory.mktemp("designs"))
    columns = ("participant_id", "group", "age", "sex", "site", "dose", "married")
    rows = [
        [*row, "ABC"[i % 3], str(i % 4 * 5), ("no", "yes")[i % 5 > 2]]
        for i, row in enumerate(read_participants(data))
    ]
    write_participants(data, rows, columns)
    return data, out


DESIGNS = (
    ("group",),
    ("group + age",),
    ("group + age + sex",),
    ("age + group",),
    ("age + sex",),
    ("group * age",),
    ("group:age + group",),
    ("C(group) + age",),
    ("group + site",),
    ("site + sex",),
    ("group + poly(age, 2)",),
    ('group + cr(age, df=3, constraints="center")',),
    ("group + C(dose)",),
    ("0 + group + age",),
    ("group + married",),
    ("group + age", ("older = age",)),
    ("group + age", ("AD-CN = group[AD] - group[CN]",)),
    ("group + age", (), ("group=AD",)),
    ("group * sex", (), ("group=AD", "sex=M")),
    ("group + site", ("B-C = site[B] - site[C]",), ("site=C",)),
)


@pytest.mark.parametrize("design", DESIGNS, ids=str)
def test_the_command_and_the_function_have_the_same_design(folders, design, monkeypatch):
    monkeypatch.setattr(hipsta_bids.group.output.write, "draw_figures", lambda *_: iter(()))
    data, out = folders
    formula, contrasts, references = (*design, (), ())[:3]
    options = ["--formula", formula, "--measures", "volume", "--name", "same", "--no-reports"]
    options += [word for contrast in contrasts for word in ("--contrast", contrast)]
    options += [word for level in references for word in ("--reference", level)]
    assert main([str(data), str(out), "group", *options]) == 0
    record = json.loads((out / "group" / "same" / "analysis.json").read_text())
    table = pd.read_csv(data / "participants.tsv", sep="\t")
    fit = hb.group(
        RANDOM.normal(2, 0.2, (len(table), 2, 2)),
        table,
        formula,
        contrasts=contrasts,
        references=dict(level.split("=") for level in references),
    )
    assert list(fit.design.columns) == record["columns"]
    assert dict(fit.design.references) == record["references"]
    weights = {contrast.name: contrast.weights.tolist() for contrast in fit.design.contrasts}
    assert weights == record["contrasts"]


@pytest.mark.parametrize("left", [2, 3])
def test_points_with_fewer_than_three_of_a_group_are_not_tested(left):
    """The others are fitted as by statsmodels; no correction finds what is not estimated."""
    random = np.random.default_rng(left)
    n, points = 24, 6
    table = pd.DataFrame({"group": ["CN", "AD"] * (n // 2), "age": random.normal(70, 5, n)})
    values = random.normal(2, 0.1, (n, points, 1))
    patients = np.flatnonzero(table["group"] == "AD")
    values[patients] -= 1.0  # found wherever it is tested
    values[patients[left:], 0] = np.nan  # few of a group
    values[patients, 1] = np.nan  # none of it
    values[np.flatnonzero(table["group"] == "CN")[:2], 2] = np.nan  # ten of it
    for correction in ("fdr2", "permutation-max", "permutation-tfce"):
        fit = hb.group(values, table, "group + age", correction=correction)
        maps = {name: values_of[0, 0].ravel() for name, values_of in fit.maps.items()}
        expected = [left == 3, False, True, True, True, True]
        for name in ("estimate", "statistic", "p", "p_corrected"):
            assert np.isfinite(maps[name]).tolist() == expected, name
        significant = fit.significant[0, 0].ravel()
        assert not significant[~np.array(expected)].any()
        assert significant[3:].all()
        rows = np.isfinite(values[:, 2, 0])
        matrix = np.column_stack([np.ones(n), table["group"] == "CN", table["age"]])[rows]
        tested = OLS(values[rows, 2, 0], matrix).fit()
        np.testing.assert_allclose(maps["statistic"][2], tested.tvalues[1], rtol=1e-9)  # rounding
