"""Figures on demand, in Python and on the command line, from files alone."""

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import hipsta_bids as hb
from hipsta_bids.cli.main import main
from hipsta_bids.errors import NothingToDoError, UsageError
from hipsta_bids.group.output import write
from hipsta_bids.group.stats import glm
from hipsta_bids.reports.group_tables import read_group

sys.path.append(str(Path(__file__).parents[1] / "group"))
from small_cohorts import write_dataset


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """Results of the group level, without its own figures; two analyses."""
    folder = tmp_path_factory.mktemp("figures")
    settings = folder / "group.toml"
    settings.write_text("[classification]\nrepeats = 2\nfolds = 3\n")
    data, out = write_dataset(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "draw_figures", lambda *_: iter(()))
        call = [str(data), str(out), "group", "--settings", str(settings), "--no-reports"]
        assert main([*call, "--name", "first"]) == 0
        fast = ["--align", "none", "--measures", "curvature", "--no-classification"]
        assert main([*call, *fast, "--name", "second"]) == 0
    return out


@pytest.fixture(autouse=True)
def _no_fit(out, monkeypatch):
    assert out.is_dir()  # fitted before

    def refuse(*_, **__):
        raise AssertionError("a model was fitted for a figure")

    monkeypatch.setattr(glm, "fit_points", refuse)


@pytest.mark.parametrize("what", ["group", "contrast", "registration", "roc"])
@pytest.mark.parametrize(("columns", "width"), [(1, 85), (2, 180)])
def test_figures_of_an_analysis_have_the_width_of_columns(out, what, columns, width):
    figure = hb.figure(what, out, name="first", columns=columns)
    assert figure.get_figwidth() * 25.4 == pytest.approx(width, abs=0.05)
    assert figure.get_figheight() * 25.4 < 236
    assert len(figure.axes) >= 4


def test_maps_are_those_of_the_tables_and_colors_those_asked_for(out):
    results = read_group(out / "group" / "first")
    figure = hb.figure("group", out, name="first", limits=(1.0, 2.0))
    means = results.table("means")
    selected = means[(means["measure"] == "thickness") & (means["hemi"] == "R")]
    maps = {axes.get_gid(): axes.images[0] for axes in figure.axes if axes.get_gid()}
    for index, group in enumerate(("CN", "AD")):
        image = maps[f"map-mean-{index}-R"]
        values = selected[selected["group"] == group]["mean"].to_numpy()
        np.testing.assert_allclose(np.asarray(image.get_array()).T.ravel(), values)
        assert image.get_clim() == (1.0, 2.0)
    figure = hb.figure("contrast", out, name="second")
    points = read_group(out / "group" / "second").table(
        "hemi-L_contrast-CNAD_desc-curvature_statmap"
    )
    maps = {axes.get_gid(): axes.images[0] for axes in figure.axes if axes.get_gid()}
    effect = np.asarray(maps["map-effect-0-L"].get_array()).T.ravel()
    np.testing.assert_allclose(effect, points["cohen_d"])


def test_a_participant_has_a_row_for_each_map(measured):
    figure = hb.figure("participant", measured, participant="sub-01", columns=1)
    maps = {axes.get_gid() for axes in figure.axes if axes.get_gid()}
    assert maps == {"map-mean-0-L", "map-mean-1-L"}
    figure = hb.figure("participant", measured, participant="01", measures=["extent_y"])
    assert "Extent y, sub-01" in [text.get_text() for text in figure.texts]


@pytest.fixture(scope="module")
def measured():
    return hb.example().out_dir


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_files_are_written_in_the_format_of_their_name(out, tmp_path, capsys, kind):
    path = tmp_path / "new" / f"roc.{kind}"
    path.parent.mkdir()
    call = ["figure", "roc", str(out), "--name", "first", "--columns", "2"]
    assert main([*call, "--dpi", "100", "-o", str(path)]) == 0
    assert f"figure: {path}" in capsys.readouterr().out
    start = path.read_bytes()[:100]
    assert {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[kind] == start[
        : 4 + (kind == "svg")
    ]
    if kind == "png":
        with Image.open(path) as picture:
            assert picture.width == pytest.approx(180 / 25.4 * 100, abs=1)


@pytest.mark.parametrize(
    ("given", "outcome"),
    [
        (["group"], (64, "several analyses; give one by --name: first, second")),
        (["roc", "--name", "second"], (66, "no classification")),
        (["registration", "--name", "second"], (66, "no registration")),
        (["group", "--name", "fist"], (66, "did you mean first")),
        (
            ["group", "--name", "first", "--measures", "volume"],
            (64, "--measures is 'volume'; choose 'thickness'"),
        ),
        (
            ["contrast", "--name", "first", "--contrasts", "AD-CN"],
            (64, "--contrasts is 'AD-CN'; choose 'CN-AD'"),
        ),
        (["contrast", "--name", "first", "--limits", "1", "0"], (64, "exchange them")),
        (["participant"], (64, "--participant-label: name the participant")),
        (["participant", "--participant-label", "99"], (66, "no map of sub-99")),
    ],
)
def test_what_is_not_there_is_told_in_one_line(out, tmp_path, capsys, given, outcome):
    code, message = outcome
    assert main(["figure", given[0], str(out), "-o", str(tmp_path / "a.pdf"), *given[1:]]) == code
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1
    assert not (tmp_path / "a.pdf").exists()


def test_errors_in_python_name_arguments(out, tmp_path):
    with pytest.raises(UsageError, match="give the name of one"):
        hb.figure("group", out)
    with pytest.raises(ValueError, match=r"^contrasts is 'AD-CN'; choose 'CN-AD'"):
        hb.figure("contrast", out, name="first", contrasts=["AD-CN"])
    with pytest.raises(UsageError, match=r"use \.pdf, \.svg or \.png"):
        hb.figure("group", out, name="first", file=tmp_path / "a.gif")
    with pytest.raises(ValueError, match="what is 'map'; choose 'participant' or"):
        hb.figure("map", out)
    with pytest.raises(NothingToDoError, match="no analysis; run the group level first"):
        hb.figure("group", tmp_path)
