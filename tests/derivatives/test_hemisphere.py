import json
import os
import sys
from pathlib import Path

import meshio
import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from nilearn.surface import load_surf_data, load_surf_mesh
from stand_ins import NAME, NX, NY, THICKNESS, TISSUES, make_maps, make_scheme

from hipsta_bids.derivatives.hemisphere import (
    fill_from_nearest,
    format_column,
    headline,
    remove_results,
    verdict,
    write_failure,
    write_results,
)
from hipsta_bids.derivatives.names import OUTPUTS, HemisphereName
from hipsta_bids.derivatives.results import SHEET_COLUMNS, ResultPlace, read_sheet
from hipsta_bids.errors import GeometryError, InputError
from hipsta_bids.geometry.catalog import DIERS, MAPS, SECTIONS, SUMMARY
from hipsta_bids.io.gifti import COORDINATE_NAMES
from hipsta_bids.types import Flag, position_text

HOLE = (2, 1)
ROW = HOLE[0] * NY + HOLE[1]


def write(root, *, hemi="L", **options):
    name = HemisphereName(subject="01", session=None, hemi=hemi, seg="demo")
    place = ResultPlace(root=root, name=name)
    maps = make_maps(hemi=hemi, **options)
    write_results(place, maps, make_scheme(), {"version": "x"}, write_meshes=True)
    return place, maps


@pytest.fixture(params=["L", "R"])
def written(request, tmp_path):
    return write(tmp_path, hemi=request.param, holes=[HOLE])


def normals(mesh):
    corners = np.asarray(mesh.coordinates, float)[np.asarray(mesh.faces)]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def test_every_output_is_written(written):
    place, _ = written
    assert {path.name for path in place.path("qc").parent.iterdir()} == {
        place.path(output.key).name for output in OUTPUTS
    }


def test_pandas_reads_sheets_as_pyarrow_does(written, monkeypatch):
    path = written[0].path("sheet")
    by_arrow = read_sheet(path, words=["subfield"])
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    by_pandas = read_sheet(path, words=["subfield"])
    assert list(by_arrow) == list(by_pandas)
    for name, values in by_arrow.items():
        np.testing.assert_array_equal(by_pandas[name], values)
        assert by_pandas[name].dtype == values.dtype


def test_sheets_are_read_where_a_folder_has_bytes_of_no_locale(written, tmp_path):
    expected = read_sheet(written[0].path("sheet"))
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xc4"))
    folder.mkdir()
    path = folder / "sheet.tsv"
    path.write_bytes(written[0].path("sheet").read_bytes())
    columns = read_sheet(path)
    assert list(columns) == list(expected)
    np.testing.assert_array_equal(columns["thickness"], expected["thickness"])


@pytest.mark.parametrize("library", ["pyarrow", "pandas"])
def test_a_table_cut_within_a_row_is_refused(written, library, monkeypatch):
    path = written[0].path("sheet")
    path.write_text(path.read_text().rstrip().rpartition("\t")[0] + "\n")
    if library == "pandas":
        monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match="not readable as a sheet"):
        read_sheet(path)


def test_sheet_table(written):
    place, maps = written
    table = pd.read_csv(place.path("sheet"), sep="\t")
    assert list(table.columns) == list(SHEET_COLUMNS)
    assert len(table) == NX * NY
    assert table.x.tolist() == np.repeat(np.arange(1, NX + 1), NY).tolist()
    assert table.y.tolist() == np.tile(np.arange(1, NY + 1), NX).tolist()
    middle = maps.sheet.points[:, :, 1].reshape(-1, 3)
    # half a unit of the last of four decimals
    np.testing.assert_allclose(table[["r", "a", "s"]], middle, atol=5e-5)
    np.testing.assert_allclose(table.thickness, maps.thickness.ravel(), atol=5e-5)
    np.testing.assert_allclose(table.curvature, maps.maps["curvature"].ravel(), atol=5e-6)
    assert table.subfield.tolist()[:: NY * 3] == ["Sub", "Sub"]
    assert table.valid.dtype == bool
    assert table.index[~table.valid].tolist() == [ROW]
    assert table.index[table.thickness.isna()].tolist() == [ROW]


def test_repaired_columns_are_marked(tmp_path):
    place, _ = write(tmp_path, repaired=[HOLE])
    table = pd.read_csv(place.path("sheet"), sep="\t")
    assert table.repaired.dtype == bool
    assert table.index[table.repaired].tolist() == [ROW]


def test_missing_is_spelled_and_zero_has_no_sign(written):
    place, _ = written
    text = place.path("sheet").read_text()
    assert text.splitlines()[1 + ROW].split("\t")[2:6] == ["n/a"] * 4
    assert "nan" not in text.lower()
    assert "-0.00000" not in text


def test_sidecars_define_every_column(written):
    place, _ = written
    for key in ("sheet", "summary", "profile", "sections", "layers"):
        columns = place.path(key).read_text().splitlines()[0].split("\t")
        definitions = sidecar(place, key)
        assert "head and tail are in no number" in definitions.pop("MeasuredRegion")
        assert list(definitions) == columns
        assert all(entry["Description"] for entry in definitions.values())


def test_every_measure_has_a_unit_and_a_source(written):
    place, _ = written
    for key, rows in (("sheet", MAPS), ("profile", MAPS), ("sections", SECTIONS)):
        for row in rows:
            definition = sidecar(place, key)[row.name]
            assert definition["Units"] == row.unit
            assert definition["Source"] == row.source
    summary = sidecar(place, "summary")
    assert summary["surface_volume_ratio"]["Units"] == "1/mm"
    assert summary["area_CA1"] == {
        "Description": "area of the mid-surface in CA1",
        "Units": "mm^2",
        "Source": DIERS,
    }
    assert summary["thickness_mean_CA1"]["Units"] == "mm"


def sidecar(place, key):
    return json.loads(place.path(f"{key}_sidecar").read_text())


def test_profile_table(written):
    place, maps = written
    table = pd.read_csv(place.path("profile"), sep="\t")
    assert table.axis.tolist() == ["x"] * NX + ["y"] * NY
    assert table.node.tolist() == [*range(1, NX + 1), *range(1, NY + 1)]
    # The mean leaves the hole out; half a unit of the last of four decimals.
    np.testing.assert_allclose(table.thickness, THICKNESS, atol=5e-5)
    for row in MAPS:
        values = [*maps.profiles["x"][row.name], *maps.profiles["y"][row.name]]
        np.testing.assert_allclose(table[row.name], values, atol=0.51 * 10.0**-row.digits)


def test_sections_table(written):
    place, maps = written
    table = pd.read_csv(place.path("sections"), sep="\t")
    assert list(table.columns) == ["y", *(row.name for row in SECTIONS)]
    assert table.y.tolist() == list(range(1, NY + 1))
    for row in SECTIONS:
        np.testing.assert_allclose(table[row.name], maps.sections[row.name], atol=5e-5)


def test_layers_table(written):
    place, maps = written
    table = pd.read_csv(place.path("layers"), sep="\t")
    assert len(table) == NX * NY * 3
    assert table.layer.tolist() == [1, 2, 3] * (NX * NY)
    points = maps.layers.points.reshape(-1, 3)
    np.testing.assert_allclose(table[["r", "a", "s"]], points, atol=5e-5)
    whole = table[(table.x != HOLE[0] + 1) | (table.y != HOLE[1] + 1)]
    assert sorted(set(whole.depth)) == [0, THICKNESS / 2, THICKNESS]
    assert sorted(set(whole.relative_depth)) == [0, 0.5, 1]


def test_sidecar_says_what_subfields_are(written):
    place, _ = written
    definitions = json.loads(place.path("sheet_sidecar").read_text())
    assert definitions["subfield"]["Levels"] == {
        "Sub": "SUBICULUM-BODY",
        "CA1": "CA1-BODY",
        "CA3": "CA3-BODY",
    }


def test_summary_table(written):
    place, _ = written
    table = pd.read_csv(place.path("summary"), sep="\t")
    assert list(table.columns)[: len(SUMMARY)] == [row.name for row in SUMMARY]
    assert table.thickness_mean.tolist() == [THICKNESS]
    assert table.volume_CA1.isna().all()


def test_quality_record(written):
    place, _ = written
    record = json.loads(place.path("qc").read_text())
    assert record["decision"] == "use"
    assert record["reason"] is None
    assert record["version"] == "x"
    assert record["undefined_columns"] == 1
    assert record["metrics"] == {"voxels": 7, "ratio": None, "caps": [1, 2]}


@pytest.mark.parametrize("surface", ["interior", "midthickness", "exterior"])
def test_surfaces_load_and_face_outward(written, surface):
    place, maps = written
    level = {"interior": 0, "midthickness": 1, "exterior": 2}[surface]
    mesh = load_surf_mesh(str(place.path(f"{surface}_surface")))
    expected = maps.sheet.points[:, :, level].reshape(-1, 3)
    there = np.isfinite(expected).all(axis=1)
    # float32 holds 40 mm to 4e-6 mm
    np.testing.assert_allclose(np.asarray(mesh.coordinates)[there], expected[there], atol=1e-5)
    assert np.isfinite(mesh.coordinates).all()
    assert len(mesh.faces) == 2 * (NX - 1) * (NY - 1)
    # z of the stand-in sheet runs from interior to exterior
    assert (normals(mesh)[:, 2] >= 0).all()
    assert (normals(mesh)[:, 2] > 0).sum() > NX * NY / 2


def test_surface_metadata_is_what_workbench_reads(written):
    place, _ = written
    side = {"L": "Left", "R": "Right"}[place.name.hemi]
    for output in OUTPUTS:
        if output.extension.endswith(".gii"):
            image = nib.load(place.path(output.key))
            assert image.meta["AnatomicalStructurePrimary"] == f"Hippocampus{side}", output.key
    image = nib.load(place.path("midthickness_surface"))
    points, faces = image.darrays
    assert points.meta["AnatomicalStructurePrimary"] == f"Hippocampus{side}"
    assert points.meta["AnatomicalStructureSecondary"] == "MidThickness"
    assert points.meta["GeometricType"] == "Anatomical"
    assert points.coordsys.dataspace == nib.nifti1.xform_codes.code["scanner"]
    np.testing.assert_array_equal(points.coordsys.xform, np.eye(4))
    assert points.intent == nib.nifti1.intent_codes.code["NIFTI_INTENT_POINTSET"]
    assert faces.intent == nib.nifti1.intent_codes.code["NIFTI_INTENT_TRIANGLE"]
    flat = nib.load(place.path("midthickness_unfold")).darrays[0]
    assert flat.meta["GeometricType"] == "Flat"
    assert flat.coordsys.dataspace == nib.nifti1.xform_codes.code["unknown"]


def test_unfolded_surfaces_are_flat_and_to_scale(written):
    place, _ = written
    mesh = load_surf_mesh(str(place.path("exterior_unfold")))
    points = np.asarray(mesh.coordinates).reshape(NX, NY, 3)
    # float32; extents of the stand-in are 4 and 6 mm, its thickness 1.5 mm
    np.testing.assert_allclose(np.ptp(points[:, 0, 0]), 4.0, atol=1e-6)
    np.testing.assert_allclose(np.ptp(points[0, :, 1]), 6.0, atol=1e-6)
    np.testing.assert_allclose(points[..., 2], 0.75, atol=1e-6)
    assert points[-1, 0, 0] > points[0, 0, 0]  # medial to lateral
    assert points[0, -1, 1] > points[0, 0, 1]  # posterior to anterior
    assert (normals(mesh)[:, 2] > 0).all()


def test_maps_load_on_the_surface(written):
    place, maps = written
    thickness = load_surf_data(str(place.path("thickness")))
    np.testing.assert_array_equal(thickness, maps.thickness.ravel().astype(np.float32))
    assert np.isnan(thickness[ROW])
    for row in MAPS:
        values = load_surf_data(str(place.path(row.name)))
        np.testing.assert_array_equal(values, maps.maps[row.name].ravel().astype(np.float32))
        assert nib.load(place.path(row.name)).darrays[0].meta["Units"] == row.unit


def test_labels_load_with_names_and_colors(written):
    place, maps = written
    labels = load_surf_data(str(place.path("subfields")))
    np.testing.assert_array_equal(labels, maps.subfield.ravel())
    table = nib.load(place.path("subfields")).labeltable
    assert table.get_labels_as_dict() == {
        0: "???",
        **{int(tissue): f"{tissue.name}-BODY" for tissue in TISSUES},
    }
    assert [label.rgba for label in table.labels][:2] == [(0, 0, 0, 0), (1, 0, 0, 1)]


def test_mesh_round_trip(written):
    place, maps = written
    mesh = meshio.read(place.path("mesh"))
    np.testing.assert_array_equal(mesh.points, maps.mesh.vertices)
    np.testing.assert_array_equal(mesh.cells_dict["tetra"], maps.mesh.tetrahedra)
    for axis, name in enumerate(COORDINATE_NAMES):
        np.testing.assert_array_equal(mesh.point_data[name], maps.coordinates.values[:, axis])  # noqa: PD011  (not pandas)


def test_same_maps_give_same_bytes(tmp_path):
    first, _ = write(tmp_path / "a", holes=[HOLE])
    second, _ = write(tmp_path / "b", holes=[HOLE])
    for output in OUTPUTS:
        assert first.path(output.key).read_bytes() == second.path(output.key).read_bytes()


def test_mesh_only_on_request_and_old_one_goes(tmp_path):
    place, maps = write(tmp_path)
    write_results(place, maps, make_scheme(), {}, write_meshes=False)
    assert not place.path("mesh").exists()
    assert all(path.exists() for path in place.paths(optional=False))


def test_failure_leaves_only_its_record(tmp_path):
    place, _ = write(tmp_path)
    other, _ = write(tmp_path, hemi="R")
    error = GeometryError("too short", reason="body-too-short")
    write_failure(place, error, {"version": "x"})
    left = [path for path in place.paths(optional=True) if path.exists()]
    assert left == [place.path("qc")]
    record = json.loads(place.path("qc").read_text())
    assert record == {
        "decision": "failed",
        "reason": "body-too-short",
        "message": "too short",
        "version": "x",
    }
    assert all(path.exists() for path in other.paths(optional=True))


def test_failure_leaves_the_body_to_be_corrected(tmp_path):
    place, maps = write(tmp_path)
    write_failure(place, GeometryError("holes", reason="topology"), {}, maps.body_mask)
    left = {path for path in place.paths(optional=True) if path.exists()}
    assert left == {place.path(key) for key in ("qc", "body_mask", "body_sources")}
    image = nib.load(place.path("body_mask"))
    assert image.shape == maps.body_mask.shape
    np.testing.assert_array_equal(image.dataobj[1:, :3, 2:5] > 0, maps.body_mask.inside)
    assert np.count_nonzero(image.dataobj) == 3
    remove_results(place)
    assert not place.path("body_mask").exists()


def test_removal_of_nothing_is_fine(tmp_path):
    remove_results(ResultPlace(root=tmp_path, name=NAME))
    assert list(tmp_path.iterdir()) == []


def test_the_flag_with_the_largest_consequence_decides():
    flags = (
        Flag(reason="a", message="one"),
        Flag(reason="b", message="two", share=0.5, change=0.01),
        Flag(reason="c", message="three", share=0.1, change=-0.2),
        Flag(reason="a", message="four", share=1.0),
    )
    assert verdict(make_maps()) == ("use", None, None)
    assert verdict(make_maps(repairs=("x",))) == ("use", None, None)
    assert verdict(make_maps(flags=flags, repairs=("x",))) == ("look", "c+b+a", "three")
    assert [f.message for f in make_maps(flags=flags).flags] == ["three", "two", "four", "one"]


PLACE = "(PRESUBICULUM, SUBICULUM, CA1)"


@pytest.mark.parametrize(
    ("message", "short"),
    [
        ("two  words", "two words"),
        (" ".join(25 * ["a"]), " ".join(25 * ["a"])),
        (" ".join(26 * ["a"]), " ".join(25 * ["a"]) + "..."),
        (f"{' '.join(20 * ['a'])}: {' '.join(20 * ['b'])}", " ".join(20 * ["a"])),
        (f"a: {' '.join(30 * ['b'])}", f"a: {' '.join(24 * ['b'])}..."),
        (f"{' '.join(23 * ['a'])} {PLACE}; correct", f"{' '.join(23 * ['a'])} {PLACE}; correct"),
        (f"{' '.join(25 * ['a'])} {PLACE}; correct", f"{' '.join(25 * ['a'])}..."),
        (
            f"{' '.join(20 * ['a'])} (b, {PLACE}). {' '.join(9 * ['c'])}",
            f"{' '.join(20 * ['a'])} (b, {PLACE})",
        ),
    ],
)
def test_headlines_have_25_words_at_most(message, short):
    assert headline(message) == short


def test_headlines_keep_the_subfields_of_a_place_and_the_remedy():
    place = position_text((-20.8, -19.0, -16.8), "PRESUBICULUM, SUBICULUM, CA1, CA3")
    problem = "holes or bridges of the labels cannot be repaired (Euler number -3, closed 1)"
    message = f"{problem}, near {place}; correct the labels there"
    assert len(message.split()) > 25
    assert headline(message) == message


def test_the_record_says_what_a_flag_means_for_the_map(tmp_path):
    flag = Flag(
        reason="a",
        message="one",
        value=1.5,
        limit=1.0,
        points=np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 3.0]]),
        share=0.25,
        change=-0.125,
    )
    place = ResultPlace(root=tmp_path, name=NAME)
    maps = make_maps(flags=(flag, Flag(reason="b", message="two")))
    write_results(place, maps, make_scheme(), {}, write_meshes=False)
    first, second = json.loads(place.path("qc").read_text())["flags"]
    assert first == {
        "reason": "a",
        "message": "one",
        "value": 1.5,
        "limit": 1.0,
        "position_ras_mm": [1.5, 3.0, 3.0],
        "columns_share": 0.25,
        "mean_change_mm": -0.125,
    }
    assert second["value"] is second["position_ras_mm"] is second["columns_share"] is None


def test_filling_takes_the_nearest_node():
    points = np.full((3, 2, 3), np.nan)
    assert np.isnan(fill_from_nearest(points)).all()
    points[0, 0], points[2, 1] = 1.0, 2.0
    filled = fill_from_nearest(points)
    np.testing.assert_array_equal(filled[..., 0], [[1, 1], [1, 2], [2, 2]])


def test_fixed_format():
    assert format_column(np.array([1.0, -1e-9, np.nan, np.inf]), 3) == [
        "1.000",
        "0.000",
        "n/a",
        "n/a",
    ]
