"""Head, body and tail on one sheet: a spiral wall along a hooked axis, whose thickness is known."""

import io
import json
import re
from contextlib import nullcontext, redirect_stdout
from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from extension_marks import PRESENT, needs
from matplotlib.figure import Figure
from scipy import ndimage

import hipsta_bids as hb
from hipsta_bids.api.maps import Measurement
from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.names import name_of_record
from hipsta_bids.errors import GeometryError, NothingToDoError, ProtocolError
from hipsta_bids.extensions.regions.disk import find_edges, level_surface, make_disk
from hipsta_bids.extensions.regions.faces import find_ridges
from hipsta_bids.participant.measure import measure_hemisphere
from hipsta_bids.phantom.head import RADIUS, HeadSpec, draw_head
from hipsta_bids.protocols.load import for_region, load_protocol
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.reports.cohort import cohort_page, correction_of, read_cohort
from hipsta_bids.reports.participant import participant_page
from hipsta_bids.settings import Settings
from hipsta_bids.types import Bool, Float, GivenEnd, HemisphereMaps, LabelVolume, Sheet, TetMesh

WHOLE = Settings().changed(body={"region": "whole"})
SHAPE = HeadSpec()
THICKNESS, (POSTERIOR, ANTERIOR) = SHAPE.thickness, SHAPE.ends


def hooked() -> LabelVolume:
    """Without the layer, which the whole sheet never has: thickness is that of the body alone."""
    volume = draw_head(SHAPE)
    return replace(volume, protocol=volume.protocol.model_copy(update={"layer": ()}))


def measure(volume: LabelVolume) -> HemisphereMaps:
    return measure_hemisphere(volume, "L", WHOLE, lambda _: nullcontext())


@pytest.fixture(scope="module")
def maps() -> HemisphereMaps:
    return measure(hooked())


def middle(maps: HemisphereMaps) -> Float:
    return maps.sheet.points[:, :, maps.sheet.middle]


def test_thickness_is_known_in_head_body_and_tail(maps: HemisphereMaps) -> None:
    y = np.broadcast_to(np.arange(51), maps.thickness.shape)
    away = maps.sheet.valid & (middle(maps)[..., 1] > 2)  # mm from the blunt end of the tail
    for rows in (y < 10, (y >= 10) & (y <= 30), y > 30):
        values = maps.thickness[rows & away]
        assert len(values) > 0.25 * np.count_nonzero(rows)
        assert abs(values.mean() - THICKNESS) <= 0.03
        assert values.std() <= 0.06


def test_nodes_of_the_body_are_those_of_its_own_sheet(maps: HemisphereMaps) -> None:
    alone = measure_hemisphere(hooked(), "L", Settings(), lambda _: nullcontext())
    apart = np.linalg.norm(middle(maps)[:, 10:31] - middle(alone), axis=-1)
    difference = maps.thickness[:, 10:31] - alone.thickness
    told = np.isfinite(difference)
    assert told.mean() > 0.88  # beside rims, within MARGIN, the whole sheet has no values
    assert np.median(apart[told]) < 0.02
    assert np.quantile(apart[told], 0.95) < 0.15
    assert np.abs(difference[told]).max() < 0.15
    inner, edge = middle(maps)[4:-4], WHOLE.grid.spacing  # mm, of the triangles that planes cross
    assert np.abs(inner[:, 10, 1] - POSTERIOR).max() < edge
    assert np.abs(inner[:, 30, 1] - ANTERIOR).max() < edge
    assert maps.qc["folded_fraction"] < 0.01


def test_what_refuses_the_body_refuses_the_whole() -> None:
    near = GivenEnd(end="anterior", point=(0, POSTERIOR + 4, 0), normal=(0, 1, 0))
    volume = hooked()
    with pytest.raises(GeometryError) as error:
        measure(replace(volume, given_ends=(volume.given_ends[0], near)))
    assert error.value.reason == "body-too-short"


def test_middle_lies_on_the_spiral_from_medial_to_lateral(maps: HemisphereMaps) -> None:
    body = middle(maps)[:, 20]
    assert np.abs(np.hypot(body[:, 0], body[:, 2])[4:-4] - RADIUS).max() < 0.1
    assert maps.subfield[2, 20] == Tissue.SUBICULUM
    assert maps.subfield[-3, 20] == Tissue.CA2_3


def test_nothing_is_told_beside_rims(maps: HemisphereMaps) -> None:
    assert np.isnan(maps.thickness[:, [0, -1]]).all()
    assert np.isnan(maps.maps["curvature"][~maps.sheet.valid]).all()
    assert np.isfinite(maps.maps["distortion"][maps.sheet.valid]).all()
    assert maps.qc["experimental"]
    assert maps.qc["holes_mm"] == []


def test_mean_curvature_is_that_of_the_spiral(maps: HemisphereMaps) -> None:
    values = maps.maps["curvature"][8:-8, 15:26]
    assert abs(np.nanmean(values) - 1 / (2 * RADIUS)) < 0.01


def test_coarse_voxels_are_refused() -> None:
    volume = hooked()
    with pytest.raises(GeometryError, match=r"0\.60 mm") as error:
        measure(replace(volume, affine=volume.affine @ np.diag([1.5, 1, 1, 1])))
    assert error.value.reason == "whole-voxels"


def test_sheet_without_its_lateral_labels_is_refused() -> None:
    volume = hooked()
    tissue = np.where(volume.tissue == Tissue.DENTATE_GYRUS, Tissue.MOLECULAR_LAYER, volume.tissue)
    tissue[0, 0, 0] = Tissue.DENTATE_GYRUS
    with pytest.raises(GeometryError) as error:
        measure(replace(volume, tissue=tissue))
    assert error.value.reason == "whole-topology"


def test_tail_without_subfields_is_refused() -> None:
    protocol = load_protocol("freesurfer")
    with pytest.raises(ProtocolError, match="headbody") as error:
        for_region(protocol, "whole")
    assert error.value.reason == "whole-subfields"
    assert for_region(protocol, "headbody") == protocol


def test_sheet_ends_along_the_transition_to_the_amygdala(maps: HemisphereMaps) -> None:
    """Labels of it lie before the front end, and beside the medial edge for 4 mm before that."""
    volume = hooked()
    points = np.moveaxis(np.indices(volume.tissue.shape), 0, -1) @ volume.affine[:3, :3].T
    x, y, z = np.moveaxis(points + volume.affine[:3, 3], -1, 0)
    turn = np.rad2deg(np.arctan2(y - SHAPE.straight, 9.0 - x))
    wall = np.abs(np.hypot(9.0 - np.hypot(x - 9.0, y - SHAPE.straight), z) - RADIUS) < 1
    front = wall & (turn > 100) & (turn < 115) & (y > SHAPE.straight)
    ends = volume.tissue == Tissue.SUBICULUM
    beside = ndimage.binary_dilation(ends, iterations=2) & ~ends & (volume.tissue == 0)
    beside &= (turn > 75) & (turn < 100) & (y > SHAPE.straight)
    tissue = np.where((front & (volume.tissue == 0)) | beside, Tissue.HATA, volume.tissue)
    found = measure(replace(volume, tissue=tissue))
    before, after = (one.qc["edge_lengths_mm"] for one in (maps, found))
    front = np.deg2rad(240) * RADIUS  # mm, all of the last section
    assert before["anterior"] < front / 2  # its subiculum and CA3 were taken for edges
    assert front < after["anterior"] < front + 4
    assert before["medial"] > after["medial"] + 2


def test_hole_is_filled_and_told() -> None:
    volume = hooked()
    points = np.moveaxis(np.indices(volume.tissue.shape), 0, -1) @ volume.affine[:3, :3].T
    points = points + volume.affine[:3, 3]
    hole = np.linalg.norm((points - [-RADIUS, 12.0, 0.0])[..., 1:], axis=-1) < 2.2
    hole &= points[..., 0] < -RADIUS / 2
    found = measure(replace(volume, tissue=np.where(hole, 0, volume.tissue)))
    reasons = [flag.reason for flag in found.flags]
    assert reasons.count("whole-hole") == 1
    assert abs(found.qc["holes_mm"][0] - 2 * np.pi * 2.2) < 4
    gap = np.linalg.norm(middle(found) - [-RADIUS, 12.0, 0.0], axis=-1)
    assert np.isnan(found.thickness[gap < 2.5]).all()
    assert np.isfinite(found.thickness[8:-8][(gap > 4)[8:-8] & (gap < 5)[8:-8]]).all()


def test_banks_that_touch_are_found_and_have_no_values() -> None:
    open_, touching = (
        measure(
            draw_head(replace(SHAPE, thickness=1.2, straight=26.0, digitations=2, exterior=width))
        )
        for width in (0.8, 0.0)
    )
    assert "fused-digitation" not in [flag.reason for flag in open_.flags]
    (flag,) = (flag for flag in touching.flags if flag.reason == "fused-digitation")
    assert "exterior" in flag.message
    assert flag.share is not None
    assert 0 < flag.share < 0.1
    assert np.nanmax(touching.thickness) < 2.0  # two walls have 2.4
    assert np.isfinite(touching.thickness).sum() > 0.95 * np.isfinite(open_.thickness).sum()


def test_low_folds_that_touch_are_ridges_without_values() -> None:
    """Their banks do not face each other; without the search columns are up to 1 mm too thick."""
    shape = replace(SHAPE, thickness=1.2, straight=30.0, digitations=2, bank=0.25, interior=0.0)
    maps = measure(draw_head(shape))
    (flag,) = (flag for flag in maps.flags if flag.reason == "fused-digitation")
    assert "ridge" in flag.message
    thick = np.abs(maps.thickness - 1.2) > 0.5
    assert thick.sum() < 0.03 * np.isfinite(maps.thickness[:, 31:]).sum()


def test_a_ridge_is_narrow() -> None:
    """A wide place of the same thickness is none, nor is one outside of the columns asked for."""
    x, y, z = np.meshgrid(np.arange(20.0), np.arange(30.0), [-0.5, 0.0, 0.5], indexing="ij")
    half = np.where((np.abs(y - 8) < 2) | (y > 18), 2.0, 1.0)
    sheet = Sheet(points=np.stack([x, y, half * z], axis=-1), valid=np.ones(x.shape[:2], bool))
    ((columns, area),) = find_ridges(sheet, np.arange(30) < 14)
    assert area == pytest.approx(19 * 3)
    assert set(np.nonzero(columns)[1]) == {7, 8, 9}
    assert find_ridges(sheet, np.arange(30) > 14) == []


@pytest.mark.parametrize(("thickness", "area"), [(1.4, 0.0), (1.6, 19 * 3)])
def test_a_ridge_is_as_thick_as_two_walls(thickness: float, area: float) -> None:
    """Half of that lies round it, but most of the head is 1 mm thick."""
    x, y, z = np.meshgrid(np.arange(20.0), np.arange(30.0), [-0.5, 0.0, 0.5], indexing="ij")
    wall = np.where(np.abs(y - 24) < 2, thickness, np.where(y > 18, 0.5, 1.0))
    sheet = Sheet(points=np.stack([x, y, wall * z], axis=-1), valid=np.ones(x.shape[:2], bool))
    areas = [each for columns, each in find_ridges(sheet, np.arange(30) >= 0) if columns[9, 24]]
    assert areas == [pytest.approx(area)]


def cube(count: int) -> TetMesh:
    """The unit cube in tetrahedra: Kuhn's six per cell."""
    grid = np.stack(np.meshgrid(*[np.arange(count + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    number = np.arange((count + 1) ** 3).reshape((count + 1,) * 3)
    cells = []
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        corner, steps = np.zeros(3, dtype=int), [number[:-1, :-1, :-1]]
        for axis in order:
            corner[axis] = 1
            part = tuple(slice(c, count + c) for c in corner)
            steps.append(number[part])
        cells.append(np.stack([s.ravel() for s in steps], axis=1))
    return TetMesh(vertices=grid / count, tetrahedra=np.concatenate(cells))


def test_level_of_a_linear_function_is_a_disk() -> None:
    mesh = cube(4)
    values = mesh.vertices @ [0.1, 0.2, 1.0]
    disk = make_disk(*level_surface(mesh, values, 0.5371))
    np.testing.assert_allclose(disk.vertices @ [0.1, 0.2, 1.0], 0.5371, atol=1e-12)
    a, b, c = (disk.vertices[disk.triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals @ [0.1, 0.2, 1.0] > 0).all()
    assert np.linalg.norm(normals, axis=1).sum() / 2 == pytest.approx(np.sqrt(1.05))
    assert disk.holes == ()


def sides(disk_points: Float, axis: int, value: float) -> Bool:
    return np.abs(disk_points[:, axis] - value) < 1e-9


def test_edges_wrap_round_the_boundary() -> None:
    mesh = cube(6)
    disk = make_disk(*level_surface(mesh, mesh.vertices[:, 2], 0.45))
    points = disk.vertices[disk.loop]
    for start in range(0, len(disk.loop), 5):
        turned = replace(disk, loop=np.roll(disk.loop, start))
        rolled = np.roll(points, start, axis=0)
        medial, lateral = (np.where(sides(rolled, 0, v), 1.0, -1.0) for v in (0.0, 1.0))
        found = find_edges(turned, medial, lateral, rolled[:, 1])
        assert sides(disk.vertices[found.medial], 0, 0.0).all()
        assert sides(disk.vertices[found.lateral], 0, 1.0).all()
        assert np.median(disk.vertices[found.anterior][:, 1]) == 1.0


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    """Output of the command with all that it can add to a hemisphere."""
    tmp_path = tmp_path_factory.mktemp("whole")
    volume = hooked()
    derivative = tmp_path / "bids/derivatives/maget"
    folder = derivative / "sub-01/anat"
    folder.mkdir(parents=True)
    about = {"Name": "x", "BIDSVersion": "1.8.0", "GeneratedBy": [{"Name": "MAGeTbrain"}]}
    (derivative / "dataset_description.json").write_text(json.dumps(about))
    codes = np.zeros(volume.tissue.shape, dtype=np.int16)
    for label in volume.protocol.labels:
        codes[volume.tissue == label.tissue] = 100 + label.code
    image = nib.Nifti1Image(codes, volume.affine)
    image.to_filename(folder / "sub-01_T1w_labels.nii.gz")
    points = np.moveaxis(np.indices(codes.shape), 0, -1) @ volume.affine[:3, :3].T
    height = (points + volume.affine[:3, 3])[..., 1].astype(np.float32)
    nib.Nifti1Image(height, volume.affine).to_filename(tmp_path / "height.nii.gz")
    (tmp_path / "ends.tsv").write_text(
        "participant_id\themi\tend\tr\ta\ts\tnr\tna\tns\n"
        f"sub-01\tL\tposterior\t0\t{POSTERIOR}\t0\t0\t1\t0\n"
        f"sub-01\tL\tanterior\t0\t{ANTERIOR}\t0\t0\t1\t0\n"
    )
    places = [str(tmp_path / "bids"), str(tmp_path / "out"), "participant", "--n-procs", "1"]
    options = ["--ends", str(tmp_path / "ends.tsv"), "--hemi", "L", "--region", "whole"]
    options += ["--map", f"height={tmp_path / 'height.nii.gz'}", "--map-sampling", "mid"]
    options += ["--write-meshes"]
    options += ["--uncertainty", "2"] if "uncertainty" in PRESENT else []
    with redirect_stdout(io.StringIO()) as said:
        assert main([*places, *options]) == 0
    assert "region whole is experimental" in said.getvalue()
    return tmp_path / "out"


def sheet_of(out: Path) -> pd.DataFrame:
    (path,) = out.glob("sub-01/anat/*_label-whole_desc-sheet_morph.tsv")
    return pd.read_csv(path, sep="\t")


def test_command_writes_beside_the_body_and_says_experimental(out: Path) -> None:
    results = out / "sub-01/anat"
    (path,) = results.glob("*_label-whole_desc-distortion_morph.shape.gii")
    assert nib.load(path).agg_data().shape == (41 * 51,)
    (record,) = results.glob("*_label-whole_desc-qc_metrics.json")
    name = name_of_record(record.name)
    assert name is not None
    assert name.region_title == "whole region (experimental)"  # as pages have it
    (sidecar,) = results.glob("*_label-whole_desc-sheet_morph.json")
    assert "experimental" in json.loads(sidecar.read_text())["MeasuredRegion"]


def test_other_volumes_have_values_where_the_sheet_has(out: Path) -> None:
    (path,) = out.glob("sub-01/anat/*_label-whole_desc-height_map.tsv")
    sheet, found = sheet_of(out), pd.read_csv(path, sep="\t").height
    assert 0.1 < sheet.thickness.isna().mean() < 0.5
    np.testing.assert_array_equal(found.isna(), sheet.thickness.isna())
    np.testing.assert_allclose(found, sheet.a.where(found.notna()), atol=0.002)  # rounded


@needs("uncertainty")
def test_uncertainty_is_that_of_the_whole_sheet(out: Path) -> None:
    (path,) = out.glob("sub-01/anat/*_label-whole_desc-uncertainty_morph.tsv")
    sheet, sd = sheet_of(out), pd.read_csv(path, sep="\t").thickness_sd
    assert sd[sheet.thickness.isna()].isna().all()
    assert sd[sheet.thickness.notna()].notna().mean() > 0.9
    assert 0.1 < sd.median() < 0.4  # mm; boundaries are drawn 0.3 mm elsewhere
    record = json.loads(next(out.glob("sub-01/anat/*_desc-qc_metrics.json")).read_text())
    assert record["metrics"]["uncertainty_failed"] == 0


def test_mesh_and_layers_are_written(out: Path) -> None:
    (path,) = out.glob("sub-01/anat/*_label-whole_desc-tet_mesh.vtu")
    assert path.stat().st_size > 100_000
    (path,) = out.glob("sub-01/anat/*_label-whole_desc-layers_morph.tsv")
    layers = pd.read_csv(path, sep="\t")
    assert len(layers) == 41 * 51 * 9


def test_page_names_the_parts_and_what_has_no_value(out: Path) -> None:
    cohort = read_cohort(out)
    page = participant_page(out, "01", None, cohort) or ""
    assert "whole region (experimental)" in page
    assert "Gray: no value, within 1 mm of edges, ends and holes." in page
    (data,) = re.findall(r'<script type="application/json">(\{"scales".*?)</script>', page)
    (scene,) = json.loads(data)["scenes"]
    assert scene["parts"] == [["tail", 0, 9], ["body", 10, 30], ["head", 31, 50]]
    assert scene["ends"] == [10, 30]
    for part in ("tail", "body", "head"):
        assert f"{part}, " in "".join(re.findall("<figcaption>(.*?)</figcaption>", page))
    command = correction_of(cohort.hemispheres, cohort.settings)["command"]
    assert "participant --edited-dir EDITS --participant-label 01 --region whole" in command
    assert "nan mm" not in page
    assert '"title": "Region"' in (cohort_page(cohort) or "")


def test_interface_loads_the_whole_sheet(out: Path) -> None:
    maps, table = hb.load(out, region="whole")
    one = maps.sel(participant="sub-01", side="L").squeeze()
    assert one.y.to_numpy()[[0, 10, 30, -1]] == pytest.approx([-2, -1, 1, 3])
    assert table.region.tolist() == ["whole"]
    sheet = sheet_of(out).thickness.to_numpy().reshape(41, 51)
    np.testing.assert_array_equal(one.thickness.to_numpy(), sheet)
    axes = hb.plot_sheet(one, ax=Figure().subplots())
    assert len(axes.lines) == 2  # the ends of the body
    with pytest.raises(NothingToDoError, match=r"there is cobralab \(region whole\)"):
        hb.load(out)


def test_interface_measures_head_and_body(maps: HemisphereMaps) -> None:
    measured = Measurement(
        side="L", protocol=load_protocol("cobralab"), settings=WHOLE, hemisphere=maps
    )
    assert dict(measured.dataset.sizes) == {"x": 41, "y": 51, "layer": 9, "ras": 3}
