"""Neighboring cortex: the longer sheet and the cortex alone, in memory and by the command line."""

from dataclasses import replace

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from extension_marks import needs
from measured_phantoms import Results, measure

from hipsta_bids.cli import main
from hipsta_bids.cli.participant import REGIONS as ALL_REGIONS
from hipsta_bids.derivatives.dataset import read_status
from hipsta_bids.derivatives.names import HemisphereName, output_path
from hipsta_bids.errors import ExitCode, GeometryError, ProtocolError
from hipsta_bids.io import files
from hipsta_bids.phantom import Hemisphere, Phantom, PhantomSpec, rigid_motion, write_dataset
from hipsta_bids.protocols import EXPERIMENTAL
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import BodySettings, Settings
from hipsta_bids.types import EditedMask

#: Those between the end planes.
REGIONS = [region for region in ALL_REGIONS if region not in EXPERIMENTAL]

#: The cortex bends round its white matter, as in life: the other way than the hippocampus.
S_SHAPE = PhantomSpec(kind="s-shape", width=30.0, curvature=(-0.15, 0.3), cortex=10.0, length=10.0)
#: The cortex bends on as the hippocampus does, a little.
SPIRAL = PhantomSpec(kind="spiral", width=28.0, curvature=(0.02, 0.3), cortex=8.0, length=10.0)
HEMISPHERES = {"L": S_SHAPE, "R": SPIRAL}


def in_region(region, **changes):
    return Settings(body=BodySettings(region=region, **changes))


def draw(spec, protocol="ashsPMC", hemi="L", **options):
    return Phantom(spec).label_volume(load_protocol(protocol), hemi=hemi, **options)


def run(bids, out, *options):
    return main.main([str(bids), str(out), "participant", "--n-procs", "1", *options])


def found(out, hemi, region, *, subject="01", seg="ashsABC3T"):
    name = HemisphereName(subject=subject, session=None, hemi=hemi, seg=seg, region=region)
    return Results(out=out, name=name)


@pytest.fixture(scope="module")
def bids(tmp_path_factory):
    root = tmp_path_factory.mktemp("regions") / "bids"
    both = [Hemisphere(subject="01", hemi=hemi, spec=spec) for hemi, spec in HEMISPHERES.items()]
    write_dataset(root, both, layouts=("ashs",))
    return root


@pytest.fixture(scope="module")
def out(bids):
    """All regions in one folder."""
    for region in REGIONS:
        assert run(bids, bids.parent / "out", "--region", region) == ExitCode.OK
    return bids.parent / "out"


@pytest.mark.parametrize("hemi", HEMISPHERES)
@pytest.mark.parametrize("region", REGIONS)
def test_size_of_every_region(out, region, hemi):
    truth = Phantom(HEMISPHERES[hemi]).region_summary(region)
    result = found(out, hemi, region)
    assert result.row["decision"] == "use"
    # What is promised for the regions: 2 %.
    for column in ("thickness_mean", "extent_x", "extent_y", "extent_z"):
        assert float(result.summary[column]) == pytest.approx(truth[column], rel=0.02), column
    # Edges cut by labels rather than by the wall are rounded by smoothing, on a short sheet most.
    assert float(result.summary["volume"]) == pytest.approx(truth["volume"], rel=0.03)


def test_subfields_of_every_region(out):
    cortex, hippocampus = {"BA35", "ERC", "PHC"}, {"SUB", "CA1", "CA2", "CA3"}
    expected = {"body": hippocampus, "extended": cortex | hippocampus, "entorhinal": cortex}
    for region, names in expected.items():
        sheet = found(out, "L", region).sheet
        assert set(sheet.subfield) == names
        assert {c for c in found(out, "L", region).summary if c.startswith("volume_")} == {
            f"volume_{label.tissue.name}"
            for label in load_protocol("ashsABC3T").labels
            if label.abbreviation in names
        }
    assert found(out, "L", "extended").sheet.subfield.iloc[0] == "BA35"
    assert found(out, "L", "extended").sheet.subfield.iloc[-1] == "CA3"
    assert found(out, "L", "entorhinal").sheet.subfield.iloc[0] == "BA35"


def test_regions_share_a_folder(bids, out, capsys):
    assert [row["region"] for row in read_status(out)] == 2 * sorted(REGIONS)
    files_of_body = [path.name for path in out.rglob("*_seg-*") if "_label-" not in path.name]
    folder = out / "sub-01" / "anat"
    for region in ("extended", "entorhinal"):
        inserted = f"_seg-ashsABC3T_label-{region}_"
        longer = [name.replace("_seg-ashsABC3T_", inserted) for name in files_of_body]
        assert sorted(path.name for path in folder.glob(f"*_label-{region}_*")) == sorted(longer)
    record = files.read_json(found(out, "L", "extended").path("qc"))
    assert (record["region"], record["metrics"]["region"]) == ("extended", "extended")
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*_seg-*")}
    capsys.readouterr()
    assert run(bids, out, "--region", "extended") == ExitCode.OK
    assert run(bids, out) == ExitCode.OK
    assert capsys.readouterr().out.count("2 unchanged, skipped") == 2
    assert run(bids, out, "--force", "--hemi", "L") == ExitCode.OK  # leaves the others alone
    after = {path: path.stat().st_mtime_ns for path in out.rglob("*_seg-*")}
    assert {path.name for path in before if before[path] != after[path]} == {
        name for name in files_of_body if "_hemi-L_" in name
    }


@needs("signals")
def test_maps_and_drawn_regions_on_other_regions(bids, tmp_path):
    labels = nib.load(next(bids.rglob("sub-01_left_*.nii.gz")))
    index = np.moveaxis(np.indices(labels.shape), 0, -1)
    field = nib.affines.apply_affine(labels.affine, index) @ [1.5, -2.0, 0.7]
    for name, data in (("field", field.astype(np.float32)), ("copy", labels.get_fdata())):
        image = nib.Nifti1Image(data.astype(np.float32), labels.affine)
        image.set_sform(labels.affine, 1)
        nib.save(image, tmp_path / f"{name}.nii.gz")
    (tmp_path / "roi.tsv").write_text("x\ty\tregion\n20\t10\tspot\n21\t10\tspot\n")
    maps = [f"{name}={tmp_path / name}.nii.gz" for name in ("field", "copy")]
    options = ["--map-sampling", "field=mid", "--map-interpolation", "copy=nearest", "--map"]
    options += [*maps, "--roi", str(tmp_path / "roi.tsv")]
    for region in ("extended", "entorhinal"):
        assert run(bids, tmp_path / "out", "--hemi", "L", "--region", region, *options) == 0
        done = found(tmp_path / "out", "L", region)
        assert done.row["decision"] == "use"
        sheet = done.sheet
        values = {
            name: pd.read_csv(done.out / output_path(done.name, "map_table", name), sep="\t")[name]
            for name in ("field", "copy")
        }
        # Four decimals of each coordinate, seven digits of single precision.
        wanted = sheet[["r", "a", "s"]] @ [1.5, -2.0, 0.7]
        np.testing.assert_allclose(values["field"], wanted, atol=1e-3)
        codes = {label.abbreviation: label.code for label in load_protocol("ashsABC3T").labels}
        # Points beside the labels' voxels see background; the sheet's subfield is the nearest.
        assert (values["copy"] == sheet.subfield.map(codes)).mean() > 0.9
        (row,) = files.read_tsv(done.path("roi"))
        spot = sheet[sheet.y.eq(10) & sheet.x.isin([20, 21])]
        assert float(row["thickness_mean"]) == pytest.approx(spot.thickness.mean(), abs=1e-3)


@pytest.mark.long
def test_cohorts_with_cortex_can_be_measured_in_every_region(tmp_path):
    cohort = tmp_path / "bids"
    options = ["--n-subjects", "1", "--cortex", "10", "--layout", "ashsPMC", "--thinning", "0"]
    assert main.main(["phantom", str(cohort), *options]) == ExitCode.OK
    truth = {row["region"]: row for row in files.read_tsv(cohort / "phantom_truth.tsv")[:3]}
    for region in ("extended", "entorhinal"):
        assert run(cohort, tmp_path / "out", "--hemi", "L", "--region", region) == ExitCode.OK
        summary = found(tmp_path / "out", "L", region, seg="ashsPMC").summary
        # What is promised for the regions.
        for column in ("thickness_mean", "extent_x"):
            wanted = float(truth[region][column])
            assert float(summary[column]) == pytest.approx(wanted, rel=0.02), (region, column)


def test_cortex_needs_labels_and_a_shape_that_goes_on(tmp_path, capsys):
    for options, words in (
        (["--cortex", "10"], "freesurfer has no labels for cortex; choose from ashs, ashsPMC"),
        (["--cortex", "10", "--layout", "ashs", "--kind", "tight"], "choose another kind"),
        (["--cortex", "-1", "--layout", "ashs"], "cortex -1"),
    ):
        command = ["phantom", str(tmp_path / "none"), "--n-subjects", "1", *options]
        assert main.main(command) == ExitCode.USAGE
        assert words in capsys.readouterr().err


def test_regions_need_labels(tmp_path, capsys):
    plain = Hemisphere(subject="01", hemi="L", spec=PhantomSpec(length=8.0))
    write_dataset(tmp_path / "bids", [plain])
    code = run(tmp_path / "bids", tmp_path / "out", "--region", "extended")
    assert code == ExitCode.BAD_DATA  # every hemisphere's input is unusable
    row = found(tmp_path / "out", "L", "extended", seg="freesurfer").row
    assert row["reason"] == "no-cortex-labels"
    assert "ashsABC3T, ashsMagdeburg7T, ashsPMC, ashsUtrecht7T" in row["message"]
    assert "Traceback" not in capsys.readouterr().err
    write_dataset(tmp_path / "none", [plain], layouts=("ashs",))
    assert run(tmp_path / "none", tmp_path / "out", "--region", "entorhinal") == (
        ExitCode.SOME_FAILED
    )
    row = found(tmp_path / "out", "L", "entorhinal").row
    assert row["reason"] == "no-cortex-labels"
    assert "BA35 or ENTORHINAL or PARAHIPPOCAMPAL" in row["message"]


def test_unknown_regions_are_wrong_use(bids, tmp_path, capsys):
    assert run(bids, tmp_path / "out", "--region", "head") == ExitCode.USAGE
    assert "extended" in capsys.readouterr().err
    (tmp_path / "a.toml").write_text('[body]\nregion = "head"\n', encoding="utf-8")
    options = ("--settings", str(tmp_path / "a.toml"))
    assert run(bids, tmp_path / "out", *options) == ExitCode.USAGE
    assert "body.region" in capsys.readouterr().err


def interior_depth(phantom, maps, **place):
    """Mean distance of the interior surface from the mid-surface, mm; negative is interior."""
    points = maps.sheet.points[:, :, 0].reshape(-1, 3)
    return float(np.nanmean(phantom.body.locate(points, reach=2.0, **place)[:, 2]))


@pytest.mark.parametrize(
    ("spec", "hemi", "region"),
    [
        (S_SHAPE, "L", "entorhinal"),
        (S_SHAPE, "R", "entorhinal"),
        (SPIRAL, "L", "entorhinal"),
        (S_SHAPE, "R", "extended"),
    ],
    ids=lambda value: value.kind if isinstance(value, PhantomSpec) else value,
)
def test_interior_continues_that_of_the_hippocampus(spec, hemi, region):
    """However the cortex bends, and however the head lies."""
    phantom = Phantom(spec)
    pose = rigid_motion((70.0, 35.0, 160.0), (3.0, -8.0, 5.0))
    volume = draw(spec, "ashsABC3T", hemi, pose=pose)  # has head and tail labels
    maps = measure(volume, hemi, in_region(region))
    # Half of the wall of 2 mm, less a tenth for what smoothing does at the rims.
    assert interior_depth(phantom, maps, hemi=hemi, pose=pose) < -0.9
    assert maps.qc["side_rule"] == ("labels" if region == "extended" else "continuity")
    assert maps.flags == ()


def test_extended_sheets_without_interior_labels():
    """Cortex that bends more than the hippocampus, so that bending as a whole misleads."""
    spec = replace(S_SHAPE, curvature=(-0.15, 0.05), interior_depth=0.0)
    pose = rigid_motion((0.0, 60.0, 0.0), (0.0, 0.0, 0.0))  # the subiculum medially, as in life
    maps = measure(draw(spec, "ashsABC3T", pose=pose), "L", in_region("extended"))
    assert maps.qc["side_rule"] == "continuity"
    assert maps.qc["bending_rad"] < -1
    assert interior_depth(Phantom(spec), maps, pose=pose) < -0.9  # as above


def test_one_label_of_cortex_has_two_ends():
    """Where all of the cortex is one label, the end at the subiculum is the lateral one."""
    maps = measure(draw(S_SHAPE, "ashsUtrecht7T"), "L", in_region("entorhinal"))
    assert set(np.unique(maps.subfield)) == {Tissue.ENTORHINAL}
    assert np.isnan(maps.qc["label_order"])
    ends = maps.sheet.points[[0, -1], :, maps.sheet.middle].reshape(-1, 3)
    u = Phantom(S_SHAPE).body.locate(ends)[:, 0].reshape(2, -1)
    assert (u[0] < 0.05).all()  # of 1; the cortex ends at a third
    assert (u[1] > 0.28).all()


def test_labels_that_contradict_the_hemisphere_are_flagged():
    """Dentate gyrus on the wrong side of a longer sheet: below it instead of within the bend."""
    volume = draw(SPIRAL)
    affine = volume.affine
    index = np.indices(volume.tissue.shape).reshape(3, -1).T
    local = Phantom(SPIRAL).body.locate(index @ affine[:3, :3].T + affine[:3, 3], reach=3.0)
    u, _, n = (column.reshape(volume.tissue.shape) for column in local.T)
    gyrus = volume.tissue == Tissue.DENTATE_GYRUS
    tissue = np.where(gyrus, np.uint8(0), volume.tissue)
    tissue[(tissue == 0) & (u > 0.5) & (n > 1.0)] = Tissue.DENTATE_GYRUS
    maps = measure(replace(volume, tissue=tissue), "L", in_region("extended"))
    assert "side-doubtful" in {flag.reason for flag in maps.flags}


def test_cortex_has_to_reach_from_end_to_end():
    volume = draw(S_SHAPE)
    cortex = volume.tissue > Tissue.HIPPOCAMPUS
    anterior = np.where(volume.tissue == Tissue.PARAHIPPOCAMPAL, np.uint8(0), volume.tissue)
    anterior[anterior == Tissue.BA35] = 0
    for region in ("extended", "entorhinal"):
        with pytest.raises(GeometryError, match=r"along 5\.\d of \d+\.\d mm") as caught:
            measure(replace(volume, tissue=anterior), "L", in_region(region))
        assert caught.value.reason == "cortex-incomplete"
    bare = replace(volume, tissue=np.where(cortex, np.uint8(0), volume.tissue))
    with pytest.raises(GeometryError) as caught:
        measure(bare, "L", in_region("extended"))
    assert caught.value.reason == "no-cortex-labels"
    with pytest.raises(ProtocolError):
        measure(draw(S_SHAPE, "freesurfer"), "L", in_region("extended"))


def test_edited_masks_are_about_the_body():
    volume = draw(S_SHAPE)
    mask = EditedMask(inside=np.isin(volume.tissue, volume.protocol.sheet), voxel=0.4)
    for region in ("extended", *EXPERIMENTAL):
        with pytest.raises(GeometryError, match="edit the labels instead") as caught:
            measure(replace(volume, edited_mask=mask), "L", in_region(region))
        assert caught.value.reason == "edited-mask-region"


@pytest.mark.long
def test_thick_slices_of_a_longer_sheet():
    """Slices of 1.5 mm: outlines and their fragments know the cortex too."""
    spec = replace(S_SHAPE, length=12.0)
    volume = draw(spec, "ashsABC3T", voxel_size=(0.4, 1.5, 0.4))
    truth = Phantom(spec).region_summary("extended")
    summary = measure(volume, "L", in_region("extended")).summary
    assert summary["thickness_mean"] == pytest.approx(truth["thickness_mean"], rel=0.02)
    assert summary["extent_x"] == pytest.approx(truth["extent_x"], rel=0.02)
