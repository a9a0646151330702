"""What sidecars say of surfaces, maps, labels and masks, as PyBIDS and the standard inherit it."""

import json

import numpy as np
import pytest
from bids import BIDSLayout
from extension_marks import needs
from stand_ins import NAME, make_maps, make_scheme

from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.dataset import linked_path, read_links
from hipsta_bids.derivatives.hemisphere import remove_results, write_failure, write_results
from hipsta_bids.derivatives.names import OUTPUTS
from hipsta_bids.derivatives.results import ResultPlace, list_results
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.catalog import MAPS, why_impossible
from hipsta_bids.io import files

COHORT = ("--n-subjects", "1", "--voxel-size", "0.6", "0.6", "0.6", "--thickness", "2.2")
IMAGES = [row for row in OUTPUTS if row.extension.endswith((".gii", ".nii.gz"))]
CURVATURE = "1/mm; with desc-gaussian, desc-gaussianInterior, desc-gaussianExterior: 1/mm^2"
RECORD = {
    "inputs": [{"file": "bids:fs:a.mgz", "sha256": "0"}, {"file": "bids:fs:b.mgz"}],
    "edited": [{"what": "mask", "file": "bids:edits:m.nii.gz"}],
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sidecars")
    assert main(["phantom", str(folder / "in"), *COHORT]) == 0
    return folder


def measure(data):
    line = [data / "in", data / "out", "participant", "--hemi", "L", "--n-procs", "1"]
    assert main(list(map(str, line))) == 0
    return data / "out"


@pytest.fixture(scope="module")
def measured(data):
    return measure(data)


def test_every_image_says_what_it_is_and_whence(measured):
    layout = BIDSLayout(measured, validate=False, is_derivative=True)
    (place,) = list_results(measured)
    links = read_links(measured)
    said = {row.key: layout.get_file(str(place.path(row.key))).get_metadata() for row in IMAGES}
    assert len(said) == 17  # six surfaces, nine maps, labels, mask
    for row in IMAGES:
        about = said[row.key]
        assert row.description in about["Description"], row.key
        assert about["SpatialReference"].startswith("orig")
        (source,) = about["Sources"]
        assert source.startswith("bids:")
        assert linked_path(source, measured, links).is_file()
    for row in MAPS:
        assert row.definition in said[row.name]["Description"]
        assert said[row.name]["Units"] == (CURVATURE if row.suffix == "curv" else row.unit)
    assert said["interior_unfold"]["Units"] == "mm"
    assert "with space-unfold: plane" in said["interior_unfold"]["SpatialReference"]
    assert said["body_mask"]["Type"] == "ROI"


def test_no_image_has_two_sidecars_in_a_folder(measured):
    """As the standard's inheritance principle has it, in the root and beside the images."""
    (place,) = list_results(measured)

    def parts(path):
        *entities, suffix = path.name.partition(".")[0].split("_")
        return set(entities), suffix

    for row in IMAGES:
        path = place.path(row.key)
        entities, suffix = parts(path)
        for folder in (path.parent, measured):
            found = [
                other.name
                for other in folder.glob("*.json")
                if parts(other)[1] == suffix and parts(other)[0] <= entities
            ]
            assert len(found) == 1, (row.key, found)


def test_sidecars_that_were_lost_come_back(data, measured):
    (place,) = list_results(measured)
    before = place.path("sheet").read_bytes()
    shared, own = measured / "thickness.json", place.path("thickness_sources")
    wanted = shared.read_text(), own.read_text()
    shared.write_text("{")
    own.unlink()
    measure(data)
    assert (shared.read_text(), own.read_text()) == wanted
    assert place.path("sheet").read_bytes() == before


@needs("uncertainty")
def test_sources_are_of_what_is_there(tmp_path):
    place = ResultPlace(root=tmp_path, name=NAME)
    maps = make_maps()

    def spread():
        files.write_text(place.path("thickness_sd"), "x")

    write_results(place, maps, make_scheme(), RECORD, write_meshes=False, write_more=spread)
    wanted = ["bids:fs:a.mgz", "bids:fs:b.mgz", "bids:edits:m.nii.gz"]
    assert json.loads(place.path("curv_sources").read_text()) == {"Sources": wanted}
    # Of an image that few datasets have, all is said beside it.
    about = json.loads(place.path("thicknessSd_sources").read_text())
    assert about["Units"] == "mm"
    assert about["Description"].startswith("SD of thickness over perturbed copies")
    assert about["Sources"] == wanted
    write_failure(place, GeometryError("holes", reason="topology"), RECORD, maps.body_mask)
    left = set(place.path("qc").parent.iterdir())
    assert left == {place.path(key) for key in ("qc", "body_mask", "body_sources")}
    remove_results(place)
    assert not list(place.path("qc").parent.iterdir())


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("thickness", [1.0, 2.0, np.nan], None),
        ("thickness", [0.0, 2.0], "thickness reaches 0 mm, which no sheet does"),
        ("thickness", [1.0, 10.0], "thickness reaches 10 mm, which no sheet does"),
        ("thickness", [2.0, 2.0], "thickness is 2 mm at all points"),
        ("volume", [2.0], None),
        ("volume", [1e6], "volume reaches 1e+06 mm^3, which no sheet does"),
        ("extent_x", [5.0, 1000.0], "extent_x reaches 1e+03 mm, which no sheet does"),
        ("area_CA1", [1e5], "area reaches"),
        ("curvature", [-100.0, 1.0], "curvature reaches -100 1/mm, which no sheet does"),
        ("gaussian_curvature_interior", [-9999.0, 9999.0], None),
        ("of_others", [-1.0, -1.0], None),
    ],
)
def test_values_that_no_sheet_has_are_named(name, values, message):
    found = why_impossible(name, np.array(values))
    assert found is None if message is None else found.startswith(message.replace("area", name))
