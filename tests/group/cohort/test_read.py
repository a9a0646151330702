"""Which measures a model is fitted to: other maps of the sheet, sampled maps, summary measures."""

import json

import numpy as np
import pytest
from extension_marks import PRESENT, needs
from pyarrow import parquet
from small_cohorts import NODES, PLAN, place_of, table, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.errors import InputError
from hipsta_bids.group.cohort.read import SHEET_MAPS, choose_measures
from hipsta_bids.group.output import write
from hipsta_bids.group.output.tables import COLUMNS
from hipsta_bids.io import files
from hipsta_bids.stats.formula import left_side

MISSING = ("03", "R")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Sheets with one more map of their own, and with a sampled one that one of them lacks."""
    data, out = write_dataset(tmp_path_factory.mktemp("measures"))
    random = np.random.default_rng(5)
    for i in range(sum(PLAN.sizes)):
        for hemi in "LR":
            place = place_of(out, f"{i + 1:02d}", hemi)
            add_column(place.path("sheet"), "extent_x", random.normal(20, 1, NODES))
            units = json.loads(place.path("sheet_sidecar").read_text())
            files.write_json(place.path("sheet_sidecar"), units | {"extent_x": {"Units": "mm"}})
            if "signals" in PRESENT and (f"{i + 1:02d}", hemi) != MISSING:
                sample(place, "T2", random.normal(100, 5, NODES) + 20 * (i >= PLAN.sizes[0]))
    return data, out


def add_column(path, name, values):
    lines = path.read_text().splitlines()
    cells = [name, *(f"{value:.4f}" for value in values.ravel())]
    path.write_text("\n".join(f"{a}\t{b}" for a, b in zip(lines, cells, strict=True)) + "\n")


def sample(place, name, values):
    from hipsta_bids.extensions.signals.files import write_map  # noqa: PLC0415  (may be absent)
    from hipsta_bids.extensions.signals.inputs import MapSource  # noqa: PLC0415
    from hipsta_bids.extensions.signals.sampling import SampledMap  # noqa: PLC0415

    source = MapSource(name=name, sampling="depth", interpolation="linear", path=place.root)
    write_map(place, source, SampledMap(values=values[:, :, None], outside=0.0, unknown=0.0), {})


@pytest.fixture
def with_figures():
    """Marks tests that look at figures."""


@pytest.fixture(autouse=True)
def _no_figures(request, monkeypatch):
    if "with_figures" not in request.fixturenames:
        monkeypatch.setattr(write, "draw_figures", lambda *_: iter(()))


def run(dataset, quick, *options):
    data, out = dataset
    return main([str(data), str(out), "group", *quick, *options]), out / "group"


@needs("signals")
def test_other_maps_are_fitted_and_handed_over(dataset, quick):
    code, group = run(dataset, quick, "--measures", "T2", "extent_x", "--name", "others")
    assert code == 0
    folder = group / "others"
    maps = table(folder / "maps.tsv")
    assert set(maps.measure) == {"T2", "extent_x"}
    # Twenty more in each patient, of a noise of five: found everywhere; and lengths nowhere.
    found = maps.set_index(["measure", "hemi"]).n_significant
    assert found["T2", "L"] == NODES[0] * NODES[1]
    assert found["extent_x", "L"] < 0.1 * NODES[0] * NODES[1]
    n = {hemi: statmap(folder, hemi, "T2").n.max() for hemi in "LR"}
    assert n == {"L": sum(PLAN.sizes), "R": sum(PLAN.sizes) - 1}
    names = {path.name for path in folder.glob("*_statmap.shape.gii")}
    assert "hemi-L_contrast-CNAD_stat-t_desc-extentX_statmap.shape.gii" in names
    schema = parquet.read_schema(folder / "maps.parquet")
    assert schema.field("extent_x_registered").metadata[b"unit"] == b"mm"
    assert schema.field("T2").metadata[b"unit"] == b"arbitrary"
    assert "curvature" in schema.names  # the maps were registered by it
    assert set(table(folder / "measures.tsv").measure) == {"volume", "thickness_mean"}


def statmap(folder, hemi, desc):
    return table(folder / f"hemi-{hemi}_contrast-CNAD_desc-{desc}_statmap.tsv")


def test_left_side_of_a_formula_picks_the_measures(dataset, quick):
    code, group = run(dataset, quick, "--formula", "thickness ~ group + age")
    assert code == 0
    folder = group / "thickness_group-age"
    assert set(table(folder / "maps.tsv").measure) == {"thickness"}
    # The file of the model says the same.
    again = ["--model", str(folder / "model.json"), "--name", "again"]
    assert run(dataset, quick, *again)[0] == 0
    assert set(table(group / "again" / "maps.tsv").measure) == {"thickness"}


def test_model_of_a_summary_measure_has_no_maps(dataset, quick):
    code, group = run(dataset, quick, "--formula", "volume ~ group + age")
    assert code == 0
    folder = group / "volume_group-age"
    assert set(table(folder / "measures.tsv").measure) == {"volume"}
    assert not list(folder.glob("*_statmap.*"))
    assert not (folder / "peaks.tsv").exists()
    assert "volume" in json.loads((folder / "analysis.json").read_text())["measures"]["summaries"]


@needs("signals")
def test_unknown_measures_list_each_known_one_once(dataset, capsys, monkeypatch):
    summary = {"extent_x": 20.0, "extent_y": 9.0, "volume": 500.0, "area_mid": 100.0}
    monkeypatch.setattr("hipsta_bids.group.cohort.read.read_summary", lambda _: summary)
    assert run(dataset, [], "--measures", "xyz")[0] == 65
    names = capsys.readouterr().err.strip().partition("; there are ")[2].split(", ")
    assert set(names) == {*SHEET_MAPS, "T2", *summary}
    assert len(names) == len(set(names))


def test_unknown_measures_are_told_where_many_are_listed(dataset, capsys, monkeypatch):
    summary = {f"area_CA{number}": 1.0 for number in range(20)}
    monkeypatch.setattr("hipsta_bids.group.cohort.read.read_summary", lambda _: summary)
    assert run(dataset, [], "--measures", "xyz")[0] == 65
    first, more, place = capsys.readouterr().err.strip().split("; ")
    assert "no measure is called 'xyz'" in first
    table = place_of(dataset[1], "01", "L").path("summary")
    assert place == f"{table} has all summary measures"
    count = len(SHEET_MAPS) + len(summary) + ("signals" in PRESENT)  # a sampled map
    assert more.endswith(f" and {count - 12} more")
    assert run(dataset, [], "--measures", "area_C19")[0] == 65
    assert capsys.readouterr().err.endswith("'area_C19'; did you mean area_CA19?\n")


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--measures", "thicknes"], 65, "did you mean thickness?"),
        (["--measures", "xyz"], 65, "there are thickness"),
        (["--formula", "thick ness ~ group"], 65, "left of ~"),
        (["--formula", "thickness ~ group", "--measures", "curvature"], 64, "differ"),
    ],
)
def test_unknown_measures_are_refused_in_one_line(dataset, capsys, options, code, words):
    before = sorted(dataset[1].glob("group/*"))
    assert run(dataset, [], *options)[0] == code
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error
    assert sorted(dataset[1].glob("group/*")) == before


def test_messages_list_a_dozen_measures():
    for count, more in ((12, ""), (13, " and 1 more")):
        others = [f"m{i}" for i in range(count)]
        with pytest.raises(InputError, match=rf"there are m0, .*, m11{more}$"):
            choose_measures(["xyz"], (), others)


def test_left_side_of_formulas():
    assert left_side("group + age") == ()
    assert left_side(" ~ group") == ()
    assert left_side("thickness + extent_x ~ group") == ("thickness", "extent_x")


@pytest.mark.usefixtures("with_figures")
@needs("signals")
def test_figures_are_those_of_the_measures(dataset, quick):
    code, group = run(dataset, quick, "--measures", "T2", "--name", "drawn")
    assert code == 0
    names = {path.stem for path in (group / "drawn" / "figures").glob("*.svg")}
    assert names == {"T2_maps", "T2_alignment", "registration", "roc"}
    drawing = (group / "drawn" / "figures" / "T2_maps.svg").read_text()
    assert ">T2 [arbitrary]<" in drawing


@needs("signals")
def test_columns_are_explained(dataset, quick):
    folder = run(dataset, quick, "--measures", "T2", "--name", "explained")[1] / "explained"
    assert set(table(folder / "peaks.tsv").columns) <= set(COLUMNS)
