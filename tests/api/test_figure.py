"""Figures on demand, in Python and on the command line, from files alone."""

import pickle

import numpy as np
import pytest
from PIL import Image
from small_cohorts import write_dataset

import hipsta_bids as hb
from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.analyses import read_group
from hipsta_bids.errors import NothingToDoError, UsageError
from hipsta_bids.group.output import write
from hipsta_bids.stats import glm


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
        (["group"], (64, "--name is missing; ")),
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
        (
            ["contrast", "--name", "first", "--contrasts", "CN-AD", "CN-AD"],
            (64, "--contrasts has several names"),
        ),
        (
            ["group", "--name", "first", "--measures", "thickness", "curvature"],
            (64, "--measures has several maps"),
        ),
        (
            ["contrast", "--name", "first", "--limits", "1", "0"],
            (64, "--limits is (1.0, 0.0); give two numbers"),
        ),
        (["contrast", "--name", "first", "--limits", "0", "inf"], (64, "--limits is (0.0, inf)")),
        (["contrast", "--name", "first", "--dpi", "0"], (64, "--dpi is 0; give 1 to 2400")),
        (["contrast", "--name", "first", "--dpi", "2401"], (64, "--dpi is 2401; give 1 to 2400")),
        (["participant"], (64, "--participant-label is missing; name the participant")),
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


@pytest.mark.parametrize(
    ("argument", "what", "given", "problem"),
    [
        ("name", "group", {}, r"is missing; .* has the analyses first, second"),
        ("contrasts", "contrast", {"contrasts": ["AD-CN"]}, "is 'AD-CN'; choose 'CN-AD'"),
        ("contrasts", "contrast", {"contrasts": ["CN-AD"] * 2}, "has several names"),
        ("contrasts", "group", {"contrasts": ["CN-AD"] * 5}, "gives 7 rows, more than the 6 of"),
        ("measures", "group", {"measures": ["volume"]}, "is 'volume'; choose 'thickness'"),
        ("measures", "group", {"measures": ["thickness", "curvature"]}, "has several maps"),
        ("what", "map", {}, "is 'map'; choose 'participant' or"),
        ("columns", "group", {"columns": 3}, "is 3; choose 1 or 2"),
        ("limits", "group", {"limits": (2.0, 1.0)}, r"is \(2\.0, 1\.0\); give two numbers"),
        ("dpi", "group", {"dpi": 0}, "is 0; give 1 to 2400"),
        ("file", "group", {"file": "a.gif"}, r"is a\.gif, .*use \.pdf, \.svg or \.png"),
        ("participant", "participant", {}, "is missing; name the participant"),
    ],
)
def test_errors_in_python_name_the_argument_in_text_and_as_data(
    out, argument, what, given, problem
):
    name = {} if argument in {"name", "participant"} else {"name": "first"}
    with pytest.raises(ValueError, match=f"^{argument} {problem}") as caught:
        hb.figure(what, out, **name, **given)
    assert isinstance(caught.value, UsageError)
    copy = pickle.loads(pickle.dumps(caught.value))  # noqa: S301 (made on this line)
    assert (copy.argument, str(copy)) == (argument, str(caught.value))


def test_a_participant_with_several_sessions_needs_one(measured, tmp_path, capsys):
    copies = tmp_path / "out"
    for session in ("1", "2"):
        for path in sorted(measured.glob("sub-01/anat/*")):
            target = copies / "sub-01" / f"ses-{session}" / "anat"
            target.mkdir(parents=True, exist_ok=True)
            name = path.name.replace("sub-01", f"sub-01_ses-{session}")
            (target / name).write_bytes(path.read_bytes())
    (copies / "desc-settings.json").write_bytes((measured / "desc-settings.json").read_bytes())
    with pytest.raises(ValueError, match=r"^session is missing; sub-01 has the sessions 1, 2$"):
        hb.figure("participant", copies, participant="01")
    hb.figure("participant", copies, participant="01", session="ses-2")
    call = ["figure", "participant", str(copies), "--participant-label", "01"]
    assert main([*call, "-o", str(tmp_path / "a.pdf")]) == 64
    told = capsys.readouterr().err
    assert told == "hipsta-bids: --session-label is missing; sub-01 has the sessions 1, 2\n"


def test_values_that_look_like_arguments_are_not_renamed(out, tmp_path, capsys):
    word = "participant: measures is name"
    call = ["figure", "contrast", str(out), "--name", "first", "--contrasts", word]
    assert main([*call, "-o", str(tmp_path / "a.pdf")]) == 64
    assert f"--contrasts is '{word}'; choose 'CN-AD'" in capsys.readouterr().err


def test_a_folder_without_an_analysis_has_no_figure(tmp_path):
    with pytest.raises(NothingToDoError, match="no analysis; run the group level first"):
        hb.figure("group", tmp_path)
