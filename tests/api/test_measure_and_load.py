"""Measuring labels in memory, and loading an output dataset."""

from dataclasses import replace

import meshio
import nibabel as nib
import numpy as np
import pytest
from extension_marks import needs
from matplotlib.figure import Figure
from measured_phantoms import measured, spiral

import hipsta_bids as hb
from hipsta_bids.api import datasets
from hipsta_bids.api import maps as api_maps
from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.hemisphere import write_failure, write_results
from hipsta_bids.derivatives.names import HemisphereName
from hipsta_bids.derivatives.results import ResultPlace
from hipsta_bids.errors import (
    GeometryError,
    HipstaError,
    InputError,
    NothingToDoError,
    ProtocolError,
)
from hipsta_bids.io import files
from hipsta_bids.phantom import encode
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import Settings
from hipsta_bids.types import Flag

SECOND = HemisphereName(subject="02", session=None, hemi="L", seg="freesurfer")


def phantom(side="L"):
    return measured(spiral(), hemi=side, voxel=0.5)


@pytest.fixture(scope="module")
def left():
    return hb.measure(phantom().volume, side="L")


class TestMeasure:
    def test_maps_are_those_of_the_stages(self, left):
        assert left.maps.keys() == left.units.keys()
        for name, values in phantom().maps.maps.items():
            np.testing.assert_array_equal(left.maps[name], values)
        assert left.summary["volume"] == phantom().maps.summary["volume"]
        assert left.decision == phantom().maps.decision
        assert left.message == ""

    @pytest.mark.parametrize("kind", ["array", "image", "file"])
    def test_codes_give_the_same_as_the_volume(self, left, kind, tmp_path):
        codes, affine = encode(phantom().volume).astype(np.int16), phantom().volume.affine
        image = nib.Nifti1Image(codes, affine)
        nib.save(image, tmp_path / "labels.nii.gz")
        given = {"array": codes, "image": image, "file": str(tmp_path / "labels.nii.gz")}
        named = {"affine": affine} if kind == "array" else {}
        found = hb.measure(given[kind], side="L", protocol="freesurfer", **named)
        # Files store affines in single precision.
        np.testing.assert_allclose(found.maps["thickness"], left.maps["thickness"], atol=2e-4)

    def test_the_other_side_of_an_image_is_left_out(self):
        name = "cobralab"
        protocol = load_protocol(name)
        case = measured(spiral(), hemi="R", voxel=0.5, protocol=name)
        codes = encode(case.volume).astype(np.int16)
        both = np.where(codes > 0, codes + protocol.shift("R"), 0)
        both[:4, :4, :4] = min(protocol.codes) + protocol.shift("L")
        found = hb.measure(both, "R", name, affine=case.volume.affine)
        np.testing.assert_allclose(found.maps["thickness"], case.maps.thickness, atol=1e-9)

    def test_settings_and_region_count(self):
        settings = Settings().changed(sheet={"x_nodes": 21})
        found = hb.measure(phantom().volume, "L", settings=settings)
        assert found.maps["thickness"].shape == (21, 21)
        with pytest.raises(ProtocolError, match="neighboring cortex"):
            hb.measure(phantom().volume, "L", region="extended")

    @pytest.mark.parametrize(
        ("named", "message"),
        [
            ({"side": "left"}, "side is 'left'; choose 'L' or 'R'"),
            ({"protocol": None}, "name the protocol"),
            ({"affine": None}, r"needs affine, \(4, 4\)"),
            ({"affine": np.zeros((4, 4))}, "invertible matrix"),
        ],
    )
    def test_what_is_missing_or_wrong_is_named(self, named, message):
        given = {"side": "L", "protocol": "freesurfer", "affine": phantom().volume.affine}
        with pytest.raises(ValueError, match=message):
            hb.measure(encode(phantom().volume), **(given | named))

    def test_an_image_has_its_own_affine(self):
        image = nib.Nifti1Image(encode(phantom().volume).astype(np.int16), phantom().volume.affine)
        with pytest.raises(ValueError, match="of its own"):
            hb.measure(image, "L", "freesurfer", affine=np.eye(4))

    def test_labels_of_another_protocol_or_shape_are_refused(self, tmp_path):
        affine = phantom().volume.affine
        with pytest.raises(ProtocolError, match="the labels fit freesurfer"):
            hb.measure(encode(phantom().volume), "L", "hippunfold", affine=affine)
        with pytest.raises(InputError, match="3 axes"):
            hb.measure(np.ones((3, 3)), "L", "freesurfer", affine=affine)
        nib.save(nib.Nifti1Image(np.zeros((9, 9, 9), np.int16), np.eye(4)), tmp_path / "no.nii.gz")
        with pytest.raises(InputError, match="zero"):
            hb.measure(tmp_path / "no.nii.gz", "L", "freesurfer")


class TestMeasurement:
    def test_dataset_has_coordinates_and_units(self, left):
        found = left.dataset
        assert found.x.to_numpy()[[0, -1]].tolist() == [-0.9, 0.9]
        assert found.y.to_numpy()[[0, -1]].tolist() == [-1.0, 1.0]
        assert found.layer.to_numpy()[[0, -1]].tolist() == [0.0, 1.0]
        assert {name: found[name].attrs["units"] for name in left.units} == left.units
        assert found.attrs == {"side": "L", "protocol": "freesurfer", "decision": "use"}
        np.testing.assert_array_equal(found.thickness, left.maps["thickness"])
        # The way from wall to wall is the thickness.
        np.testing.assert_allclose(found.depth.sel(layer=1.0), found.thickness, rtol=1e-6)
        names = np.unique(found.subfield)
        assert {"CA1", "Sub"} <= set(names.tolist())

    @pytest.mark.parametrize("side", ["L", "R"])
    def test_triangles_face_the_exterior(self, side):
        found = hb.measure(phantom(side).volume, side)
        middle, outer = (found.surface(level).points for level in ("midthickness", "exterior"))
        corners = middle[found.surface().triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outward = (outer - middle)[found.surface().triangles].mean(axis=1)
        assert ((normals * outward).sum(axis=1) > 0).mean() > 0.99

    def test_an_unknown_surface_is_refused(self, left):
        with pytest.raises(ValueError, match="level is 'pial'"):
            left.surface("pial")

    def test_a_surface_is_written_with_its_maps(self, left, tmp_path):
        found = left.surface("exterior", tmp_path / "left.vtk")
        again = meshio.read(tmp_path / "left.vtk")
        np.testing.assert_array_equal(again.points, found.points)
        assert again.point_data.keys() == left.maps.keys()


def write(root, subject, side, *, session=None, seg="freesurfer", fail=False):
    name = HemisphereName(subject=subject, session=session, hemi=side, seg=seg)
    place, case = ResultPlace(root=root, name=name), phantom(side)
    if fail:
        error = GeometryError("there is a gap", reason="body-interrupted")
        write_failure(place, error, {})
    else:
        write_results(place, case.maps, case.volume.protocol, {}, write_meshes=False)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """Two participants with two sides, of which one failed, and one with one side."""
    root = tmp_path_factory.mktemp("out")
    dataset.settle_settings(root, Settings())
    for subject, side in (("01", "L"), ("01", "R"), ("02", "L"), ("03", "R")):
        write(root, subject, side)
    write(root, "02", "R", fail=True)
    return root


class TestLoad:
    def test_maps_are_those_that_were_written(self, out):
        maps, table = hb.load(out)
        assert dict(maps.thickness.sizes) == {
            "protocol": 1, "participant": 3, "session": 1, "side": 2, "x": 41, "y": 21,
        }  # fmt: skip
        for side in "LR":
            case = phantom(side)
            own = maps.sel(participant="sub-01", side=side).squeeze()
            np.testing.assert_allclose(own.thickness, case.maps.thickness, atol=6e-5)
            middle = case.maps.sheet.points[:, :, case.maps.sheet.middle]
            np.testing.assert_allclose(own.position, middle, atol=6e-5)
            np.testing.assert_array_equal(own.valid, case.maps.sheet.valid)
            np.testing.assert_array_equal(own.repaired, case.maps.repaired)
            np.testing.assert_array_equal(own.subfield, hb.measure(case.volume, side).subfield)
            row = table[(table.participant_id == "sub-01") & (table.hemi == side)]
            assert row["volume"].item() == pytest.approx(case.maps.summary["volume"], abs=1e-3)
        assert maps.thickness.attrs["units"] == "mm"
        assert maps.x.to_numpy()[-1] == 0.9

    @needs("uncertainty")
    @needs("signals")
    def test_uncertainty_and_sampled_maps_are_beside_them(self, tmp_path):
        from hipsta_bids.extensions.signals.files import write_map  # noqa: PLC0415  (may be absent)
        from hipsta_bids.extensions.signals.inputs import MapSource  # noqa: PLC0415
        from hipsta_bids.extensions.signals.sampling import SampledMap  # noqa: PLC0415
        from hipsta_bids.extensions.uncertainty.files import write_spread  # noqa: PLC0415

        dataset.settle_settings(tmp_path, Settings())
        write(tmp_path, "01", "L")
        write(tmp_path, "02", "L")
        maps = phantom().maps
        place = ResultPlace(root=tmp_path, name=SECOND)
        write_spread(place, {n: 0.1 + 0 * m for n, m in maps.maps.items()}, {}, 8)
        values = np.stack([maps.thickness, -maps.thickness], axis=2)
        source = MapSource(name="bold", sampling="mid", interpolation="linear", path=None)
        write_map(place, source, SampledMap(values=values, outside=0, unknown=0), {"Name": "bold"})
        record = files.read_json(place.path("qc"))
        files.write_json(place.path("qc"), record | {"maps": [{"name": "bold"}]})
        found = hb.load(tmp_path).maps.sel(side="L").squeeze()
        known = found.sel(participant="sub-02")
        np.testing.assert_allclose(known.bold_2, -maps.thickness, rtol=1e-6)
        np.testing.assert_allclose(known.thickness_sd, 0.1 + 0 * maps.thickness, atol=1e-9)
        assert found.thickness_sd.attrs["units"] == "mm"
        assert "volume 2 of the source" in found.bold_2.attrs["long_name"]
        assert np.isnan(found.bold_1.sel(participant="sub-01")).all()

    def test_what_failed_or_is_not_there_is_missing(self, out):
        maps, table = hb.load(out)
        failed = maps.sel(participant="sub-02", side="R", session="n/a")
        assert failed.decision.item() == "failed"
        assert np.isnan(failed.thickness).all()
        absent = maps.sel(participant="sub-03", side="L", session="n/a")
        assert absent.decision.item() == ""
        assert np.isnan(absent.thickness).all()
        assert not absent.valid.any()
        assert (absent.subfield == "").all()
        row = table[table.decision == "failed"]
        assert row[["participant_id", "reason", "message"]].to_numpy().tolist() == [
            ["sub-02", "body-interrupted", "there is a gap"]
        ]
        assert len(table) == 5

    def test_only_what_is_used_is_read(self, out, monkeypatch):
        read = []
        original = datasets.read_sheet

        def counted(path, *given, **named):
            read.append(path.name)
            return original(path, *given, **named)

        monkeypatch.setattr(datasets, "read_sheet", counted)
        maps, _ = hb.load(out)
        chosen = maps.thickness.sel(participant=["sub-01", "sub-03"], side="L")
        assert read == []
        chosen.mean().compute()
        assert [name[:15] for name in read] == ["sub-01_hemi-L_s"]

    def test_selections_are_those_of_the_whole(self, out):
        lazy, whole = hb.load(out).maps.thickness, hb.load(out).maps.thickness.load()
        for part in (
            {"participant": [2, 0], "x": slice(None, None, 5)},
            {"side": 1, "y": [3, 3, 1]},
            {"participant": slice(1, None), "session": 0, "x": -1},
        ):
            np.testing.assert_array_equal(lazy.isel(part), whole.isel(part))

    def test_sessions_are_an_axis(self, tmp_path):
        dataset.settle_settings(tmp_path, Settings())
        for session in ("1", "2"):
            write(tmp_path, "01", "L", session=session)
        maps, table = hb.load(tmp_path)
        assert maps.session.to_numpy().tolist() == ["ses-1", "ses-2"]
        assert table.session_id.tolist() == ["ses-1", "ses-2"]

    def test_protocols_are_an_axis(self, tmp_path):
        dataset.settle_settings(tmp_path, Settings())
        write(tmp_path, "01", "L", seg="freesurfer")
        write(tmp_path, "01", "R", seg="other")
        maps, table = hb.load(tmp_path)
        assert maps.protocol.to_numpy().tolist() == ["freesurfer", "other"]
        assert table["protocol"].tolist() == ["freesurfer", "other"]
        left, right = (maps.thickness.sel(side=side).squeeze() for side in "LR")
        np.testing.assert_allclose(left[0], phantom("L").maps.thickness, atol=6e-5)
        np.testing.assert_allclose(right[1], phantom("R").maps.thickness, atol=6e-5)
        assert np.isnan(left[1]).all()
        other = hb.load(tmp_path, protocol="other")
        assert other.maps.protocol.to_numpy().tolist() == ["other"]
        assert other.measures["hemi"].tolist() == ["R"]
        with pytest.raises(ValueError, match="one protocol, one session"):
            hb.group(maps.thickness, table, "1")
        assert hb.plot_sheet(maps.sel(side="R", protocol="other"), ax=Figure().subplots())
        with pytest.raises(NothingToDoError, match=r"there is freesurfer \(region body\), other"):
            hb.load(tmp_path, protocol="ashs")

    def test_an_empty_folder_is_refused(self, tmp_path):
        with pytest.raises(HipstaError, match="run the participant level first"):
            hb.load(tmp_path)


def test_flags_are_handed_on():
    flag = Flag(reason="folded", message="it folds", share=0.1)
    maps = replace(phantom().maps, repairs=("a tunnel was closed",), flags=(flag,))
    found = api_maps.Measurement(
        side="L", protocol=phantom().volume.protocol, settings=Settings(), hemisphere=maps
    )
    assert (found.decision, found.message) == ("look", "it folds")
