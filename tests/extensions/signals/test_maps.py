"""Other volumes and regions on the sheet, through the command line."""

import json
import re
import shutil
from fnmatch import fnmatch
from pathlib import Path

import nibabel as nib
import numpy as np
import pandas as pd
import pytest

from hipsta_bids.cli import main
from hipsta_bids.derivatives.dataset import read_status
from hipsta_bids.derivatives.names import EXTRA_OUTPUTS, HemisphereName, output_name, output_path
from hipsta_bids.errors import ExitCode, InputError
from hipsta_bids.inputs.regions import read_regions
from hipsta_bids.phantom import Hemisphere, PhantomSpec, write_dataset

SPEC = PhantomSpec(kind="arc", thickness=2.0, length=8.0)
COARSE = "[grid]\nspacing = 0.5\n"  # mm; these tests look at what is sampled, not at thickness
VOXEL = 0.7
SLOPE, LEVEL = np.array([1.5, -2.0, 0.7]), 40.0


@pytest.fixture(scope="module")
def bids_dir(tmp_path_factory):
    """One subject with both hemispheres, and images in the space of the labels."""
    root = tmp_path_factory.mktemp("maps")
    bids = root / "bids"
    hemispheres = [Hemisphere(subject="01", hemi=hemi, spec=SPEC) for hemi in "LR"]
    write_dataset(bids, hemispheres, voxel_size=(0.5, 0.5, 0.5))
    (root / "coarse.toml").write_text(COARSE)
    affine, points = field_of_view(bids)
    field = points @ SLOPE + LEVEL
    save(bids, "T1w", field, affine)
    save(bids, "quadratic", (points**2).sum(axis=-1), affine)
    save(bids, "bold", np.stack([field, 2 * field, -field], axis=-1), affine)
    save(bids, "dseg", np.where(points[..., 1] > points[..., 1].mean(), 2017, 53), affine, np.int16)
    save(bids, "nan", np.where(points[..., 1] > points[..., 1].mean(), field, np.nan), affine)
    save(bids, "complex", field + 1j, affine, np.complex64)
    save(bids, "fivedim", np.stack([np.stack([field] * 2, -1)] * 2, -1), affine)
    save(bids, "elsewhere", field, affine + shift(40.0))
    save(bids, "cut", field[:, :, : half_way(bids, affine)], affine)
    save(bids, "half_hemi-L", field, affine)
    (bids / "sub-01" / "anat" / "sub-01_broken.nii.gz").write_bytes(b"not an image")
    return bids


def shift(distance):
    moved = np.zeros((4, 4))
    moved[1, 3] = distance
    return moved


def half_way(bids, affine):
    """Index along the third axis below which half of the left hemisphere's labels lie."""
    image = nib.load(next(bids.rglob("lh.hippoAmygLabels*.mgz")))
    index = np.argwhere(np.asanyarray(image.dataobj) > 0)
    points = nib.affines.apply_affine(np.linalg.inv(affine) @ image.affine, index)
    return int(np.median(points[:, 2]))


def field_of_view(bids):
    """Voxels of 0.7 mm, turned a little, round both hemispheres: affine and centers."""
    corners = []
    for path in bids.rglob("*hippoAmygLabels*.mgz"):
        image = nib.load(path)
        index = np.argwhere(np.asanyarray(image.dataobj) > 0)
        corners.append(nib.affines.apply_affine(image.affine, index))
    points = np.concatenate(corners)
    angle = np.deg2rad(8)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    inside = points @ turn
    low, high = inside.min(axis=0) - 3, inside.max(axis=0) + 3
    affine = np.eye(4)
    affine[:3, :3] = turn * VOXEL
    affine[:3, 3] = turn @ low
    index = np.moveaxis(np.indices(np.ceil((high - low) / VOXEL).astype(int)), 0, -1)
    return affine, index @ affine[:3, :3].T + affine[:3, 3]


def save(bids, name, data, affine, dtype=np.float32):
    path = bids / "sub-01" / "anat" / f"sub-01_{name}.nii.gz"
    path.parent.mkdir(parents=True, exist_ok=True)
    image = nib.Nifti1Image(data.astype(dtype), affine)
    image.set_sform(affine, 1)
    nib.save(image, path)


def pattern(name):
    return f"sub-{{subject}}/ses-{{session}}/anat/sub-{{subject}}_ses-{{session}}_{name}.nii.gz"


def run(bids_dir, out, *options, hemi="L"):
    settings = ["--settings", str(bids_dir.parent / "coarse.toml"), "--n-procs", "1"]
    common = [str(bids_dir), str(out), "participant", "--hemi", *hemi]
    return main.main([*common, *settings, *options])


def path_of(out, key, desc=None, hemi="L"):
    name = HemisphereName(subject="01", session=None, hemi=hemi, seg="freesurfer")
    return out / output_path(name, key, desc)


def table(out, key, desc=None, hemi="L"):
    return pd.read_csv(path_of(out, key, desc, hemi), sep="\t")


@pytest.fixture(scope="module")
def regions(tmp_path_factory):
    path = tmp_path_factory.mktemp("roi") / "regions.tsv"
    rows = ["x\ty\tregion"]
    rows += [f"{x}\t{y}\tmedial" for x in range(3, 9) for y in range(5, 15)]
    rows += [f"{x}\t{y}\tlateral" for x in range(30, 36) for y in range(5, 15)]
    path.write_text("\n".join([*rows, "20\t10\tn/a"]) + "\n")
    return path


@pytest.fixture(scope="module")
def done(bids_dir, regions, tmp_path_factory):
    """A run with maps of many kinds."""
    out = tmp_path_factory.mktemp("out")
    names = ("T1w", "quadratic", "bold", "nan", "complex", "fivedim", "elsewhere", "cut", "broken")
    maps = [f"{name}={pattern(name)}" for name in names]
    maps += [f"seg={pattern('dseg')}", f"half={pattern('half_hemi-{hemi}')}", "none=no/file.nii"]
    choices = ["--map-interpolation", "seg=nearest", "--map-sampling", "quadratic=mid"]
    code = run(bids_dir, out, "--map", *maps, *choices, "--roi", str(regions), hemi="LR")
    return out, code


@pytest.fixture(scope="module")
def sheet(done):
    return table(done[0], "sheet")


def ras(sheet):
    return sheet[["r", "a", "s"]].to_numpy()


def test_nothing_fails(done):
    out, code = done
    assert code == ExitCode.OK
    assert {row["decision"] for row in read_status(out)} == {"look"}


def test_a_linear_field_comes_back(done, sheet):
    found = table(done[0], "map_table", "T1w")
    assert found[["x", "y"]].to_numpy().tolist() == sheet[["x", "y"]].to_numpy().tolist()
    expected = ras(sheet) @ SLOPE + LEVEL
    # The mean over a column is the value at its middle point where the column is straight; real
    # ones bend by less than 0.1 mm (slope 2.6 per mm).
    assert np.abs(found["T1w"] - expected).max() < 0.26
    assert np.abs(found["T1w"] - expected).mean() < 0.03


def test_a_quadratic_field_comes_back_on_the_mid_surface(done, sheet):
    found = table(done[0], "map_table", "quadratic")["quadratic"] - (ras(sheet) ** 2).sum(axis=1)
    # Linear interpolation exceeds x^2 by at most h^2 / 4 along each axis; single precision and the
    # four decimals of positions add 0.01 at values up to 2,000.
    assert found.min() > -0.01
    assert found.max() < 3 * VOXEL**2 / 4 + 0.01


def test_four_dimensions_give_a_column_each(done):
    out, _ = done
    found = table(out, "map_table", "bold")
    one = table(out, "map_table", "T1w")["T1w"]
    assert list(found.columns) == ["x", "y", "bold", "bold_1", "bold_2", "bold_3"]
    np.testing.assert_allclose(found["bold"], 2 * one / 3, rtol=1e-5)  # the mean
    # Values are written with seven digits, and read from single precision.
    np.testing.assert_allclose(found["bold_1"], one, rtol=1e-5)
    np.testing.assert_allclose(found["bold_2"], 2 * one, rtol=1e-5)
    image = nib.load(path_of(out, "map_series", "bold"))
    assert len(image.darrays) == 3
    np.testing.assert_allclose(image.darrays[2].data, -one, rtol=1e-5)
    assert not path_of(out, "map_shape", "bold").exists()


def test_labels_come_back_as_labels(done, sheet):
    out, _ = done
    found = table(out, "map_table", "seg")["seg"]
    assert set(found) == {2017, 53}
    labels = nib.load(path_of(out, "map_shape", "seg")).darrays[0].data
    np.testing.assert_array_equal(labels, found)
    order = sheet["a"].rank()
    assert found[order > 0.8 * len(found)].eq(2017).all()
    assert found[order < 0.2 * len(found)].eq(53).all()


def test_nan_voxels_are_missing_values(done):
    out, _ = done
    found = table(out, "map_table", "nan")["nan"]
    whole = table(out, "map_table", "T1w")["T1w"]
    assert 0.2 < found.isna().mean() < 0.8
    # Where half of a column or of a voxel's neighbors is known, their mean is that of one side: off
    # by up to half a column and half a voxel, 1.4 mm, times the slope of 2.6 per mm.
    assert (found - whole).abs().max() < 3.7
    assert (found - whole).abs().median() < 0.01


def test_gifti_has_the_values_and_nan(done):
    out, _ = done
    values = nib.load(path_of(out, "map_shape", "nan")).darrays[0].data
    np.testing.assert_allclose(values, table(out, "map_table", "nan")["nan"], rtol=1e-6)


def test_what_cannot_be_used_gets_one_line_each(done):
    out, _ = done
    record = json.loads(path_of(out, "qc").read_text())
    flags = [(flag["reason"], flag["message"]) for flag in record["flags"]]
    lines = {message.split(":")[0]: (reason, message) for reason, message in flags}
    for name, what in (
        ("complex", "its voxels are complex numbers"),
        ("fivedim", "has shape"),
        ("broken", "cannot be read as an image"),
    ):
        reason, message = lines[f"map {name}"]
        assert (reason, "\n" in message) == ("map-unusable", False)
        assert what in message
        assert not path_of(out, "map_table", name).exists()
    for name, share in (("elsewhere", 1.0), ("cut", 0.5)):
        assert lines[f"map {name}"][0] == "map-outside"
        (entry,) = [entry for entry in record["maps"] if entry["name"] == name]
        # Half of the labels lie outside; those of the sheet are not spread as all labels are.
        assert entry["outside"] == pytest.approx(share, abs=1 / 3)
        assert table(out, "map_table", name)[name].isna().mean() == entry["missing"] > 0.3
    assert not {"map T1w", "map bold", "map nan", "map seg", "map none"} & lines.keys()


def test_a_missing_file_is_a_note_and_harms_nobody(done):
    out, _ = done
    for hemi, exists in (("L", True), ("R", False)):
        record = json.loads(path_of(out, "qc", hemi=hemi).read_text())
        (entry,) = [entry for entry in record["maps"] if entry["name"] == "half"]
        assert ("note" in entry) != exists
        assert path_of(out, "map_table", "half", hemi).exists() == exists
        assert path_of(out, "map_table", "T1w", hemi).exists()
    assert "no file" in entry["note"]


def test_the_sidecar_says_where_values_come_from(done):
    sidecar = json.loads(path_of(done[0], "map_sidecar", "quadratic").read_text())
    assert sidecar["Source"] == "bids:bids:sub-01/anat/sub-01_quadratic.nii.gz"
    description = json.loads((done[0] / "dataset_description.json").read_text())
    assert description["DatasetLinks"]["bids"].endswith("/bids")
    assert (sidecar["Sampling"], sidecar["Interpolation"]) == ("mid", "linear")
    assert (sidecar["Outside"], sidecar["Missing"], sidecar["Volumes"]) == (0, 0, 1)
    assert set(sidecar) >= set(table(done[0], "map_table", "quadratic").columns)


def test_regions_are_summed_up(done, sheet):
    out, _ = done
    found = table(out, "roi").set_index("region")
    assert list(found.index) == ["medial", "lateral"]
    for region, (low, high) in {"medial": (3, 8), "lateral": (30, 35)}.items():
        row, here = found.loc[region], sheet["x"].between(low, high) & sheet["y"].between(5, 14)
        assert row["n_points"] == 60
        valid = here & sheet["valid"]
        for name in ("thickness", "curvature", "gaussian_curvature"):
            # Four decimals of the sheet table, five of curvature.
            assert row[f"{name}_mean"] == pytest.approx(sheet[name][valid].mean(), abs=1e-4)
            assert row[f"{name}_sd"] == pytest.approx(sheet[name][valid].std(), abs=1e-4)
        values = table(out, "map_table", "T1w")["T1w"][valid]
        assert row["T1w_mean"] == pytest.approx(values.mean(), rel=1e-5)
        assert row["seg_mode"] in (2017, 53)
        # 60 nodes of a grid that spans 18 mm x 8 mm by 40 x 20 steps; areas of cells vary.
        assert row["area"] == pytest.approx(60 * 18 / 40 * 8 / 20, rel=0.25)
    assert set(json.loads(path_of(out, "roi_sidecar").read_text())) == {"region", *found.columns}


@pytest.mark.long
def test_a_run_with_other_maps_redoes_and_tidies_up(bids_dir, regions, tmp_path, capsys):
    def lines(*options):
        capsys.readouterr()
        assert run(bids_dir, tmp_path, "-v", *options) == ExitCode.OK
        return capsys.readouterr().out

    plain = f"T1w={pattern('T1w')}"
    assert "skipped" not in lines("--map", plain)
    assert "unchanged, skipped" in lines("--map", plain)
    assert "skipped" not in lines("--map", plain, "--map-sampling", "mid")
    path_of(tmp_path, "map_table", "T1w").unlink()
    assert "skipped" not in lines("--map", plain, "--map-sampling", "mid")
    assert "skipped" not in lines("--roi", str(regions))
    assert path_of(tmp_path, "roi").exists()
    assert not list(tmp_path.rglob("*desc-T1w*"))
    assert "skipped" not in lines()
    assert not path_of(tmp_path, "roi").exists()


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("x\ty\n1\t1\n", "lacks region"),
        ("x\ty\tregion\tcolor\n1\t1\ta\tred\n", "has unknown color"),
        ("x\ty\tregion\n1\t1\ta\n42\t1\ta\n", "point x=42, y=1 lies off the sheet (1 in all)"),
        ("x\ty\tregion\n0\t1\ta\n", "lies off the sheet"),
        ("x\ty\tregion\n1.5\t1\ta\n", "is no pair of whole numbers"),
        ("x\ty\tregion\n1\t1\ta\n1\t1\ta\n", "occurs 2 times in region a"),
        ("x\ty\tregion\n1\t1\tn/a\n", "no point belongs to a region"),
        ("", "no point belongs to a region"),
        ("x\ty\tregion\n1\t1\n", "line 2 has 2 cells, the header 3"),
        (None, "file not found"),
    ],
)
def test_bad_regions_are_one_line(content, what, tmp_path):
    path = tmp_path / "r.tsv"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError) as error:
        read_regions(path, (41, 21))
    assert what in str(error.value)
    assert "\n" not in str(error.value)


def test_bad_regions_harm_nothing_else(bids_dir, tmp_path):
    roi = tmp_path / "r.tsv"
    roi.write_text("x\ty\tregion\n99\t1\ta\n")
    out = tmp_path / "out"
    assert run(bids_dir, out, "--roi", str(roi), "--map", f"T1w={pattern('T1w')}") == ExitCode.OK
    (row,) = read_status(out)
    assert (row["decision"], row["reason"]) == ("look", "roi-unusable")
    assert not path_of(out, "roi").exists()
    assert path_of(out, "map_table", "T1w").exists()
    assert path_of(out, "thickness").exists()


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (["--map", "T1w"], "not of the form NAME=PATTERN"),
        (["--map", "a_b=x"], "not a name of letters and digits"),
        (["--map", "sheet=x"], "belongs to other outputs"),
        (["--map", "thickness=x"], "belongs to other outputs"),
        (["--map", "a=x", "a=y"], "occurs twice"),
        (["--map", "a=sub-{sub}.nii"], "'sub' is not understood"),
        (["--map", "a=sub-{.nii"], "is not understood"),
        (["--map", "a=x", "--map-sampling", "b=mid"], "there is no --map b="),
        (["--map", "a=x", "--map-sampling", "top"], "is not depth, mid, interior or exterior"),
        (["--map", "a=x", "--map-interpolation", "a=cubic"], "is not linear or nearest"),
    ],
)
def test_wrong_options_get_one_line(bids_dir, tmp_path, options, what, capsys):
    assert run(bids_dir, tmp_path / "out", *options) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert what in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_dry_run_says_which_maps_there_are(bids_dir, tmp_path, capsys):
    options = ["--map", f"half={pattern('half_hemi-{hemi}')}", "all=sub-*/anat/*_T1w.nii.gz"]
    options += ["many=sub-*/anat/*.nii.gz", "fs=derivatives/*/sub-{subject}/mri/{side}.*.mgz"]
    assert run(bids_dir, tmp_path / "out", "--dry-run", *options, hemi="LR") == ExitCode.OK
    said, warnings = capsys.readouterr()
    assert "map half: 1 of 2 hemispheres have a file; not sub-01 hemi-R (no file sub-01" in said
    assert "map all: 2 of 2 hemispheres\n" in said
    assert "map fs: 2 of 2 hemispheres\n" in said
    assert "map many: 0 of 2 hemispheres have a file; not sub-01 hemi-L (11 files match" in said
    absent = "no hemisphere has this map; check the pattern sub-*/anat/*.nii.gz"
    assert warnings == f"warning: --map many: {absent}\n"


def test_sessions_are_filled_in(bids_dir, tmp_path, capsys):
    data = tmp_path / "bids"
    source = bids_dir / "derivatives" / "freesurfer" / "sub-01"
    shutil.copytree(source, data / "derivatives" / "freesurfer" / "sub-01_ses-a")
    image = data / "sub-01" / "ses-a" / "anat" / "sub-01_ses-a_T1w.nii.gz"
    image.parent.mkdir(parents=True)
    image.touch()
    command = [str(data), str(tmp_path / "out"), "participant", "--dry-run"]
    assert main.main([*command, "--map", f"T1w={pattern('T1w')}"]) == ExitCode.OK
    assert "map T1w: 2 of 2 hemispheres\n" in capsys.readouterr().out


def test_the_page_lists_the_extra_outputs():
    name = HemisphereName(subject="X", session=None, hemi="L", seg="P")
    docs = Path(__file__).parents[3] / "docs"
    page = (docs / "maps.md").read_text(encoding="utf-8")
    visits = (docs / "longitudinal-maps.md").read_text(encoding="utf-8")
    patterns = re.findall(r"`[^`]*/(\*_desc-[^`.]*)\.", visits)  # sidecars have the same stem
    assert len(patterns) == 6
    for row in EXTRA_OUTPUTS:
        spelled = output_name(name, row.key, "NAME" if row.desc == "*" else None)
        stem = spelled.partition(".")[0]
        listed = f"`{spelled.removeprefix(name.stem)}`" in page
        assert listed or any(fnmatch(stem, pattern) for pattern in patterns), spelled


@pytest.mark.parametrize("word", ["NA", "unknown", "-", "", "n/a"])
def test_points_without_a_region_are_in_none(tmp_path, word):
    path = tmp_path / "t.tsv"
    path.write_text(f"x\ty\tregion\n1\t1\t{word}\n1\t2\tCA1\n")
    assert read_regions(path, (2, 2)).member.sum() == 1
