"""``hipsta-bids export``: surfaces and maps for other programs are those of the output dataset."""

import meshio
import nibabel as nib
import numpy as np
import pytest
from nibabel.affines import apply_affine

import hipsta_bids as hb
from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.results import list_results, read_sheet
from hipsta_bids.io.gifti import read_mesh

LEVELS = {"inner": "interior", "mid": "midthickness", "outer": "exterior"}


@pytest.fixture(scope="module")
def results():
    return hb.example().out_dir


def export(*arguments):
    return main(["export", *map(str, arguments)])


def first_hemisphere(results):
    place = list_results(results)[0]
    return place, f"sub-{place.name.subject}", f"{place.name.hemi.lower()}h.hippo_"


def test_freesurfer_surfaces_are_in_the_scanners_space(results, tmp_path, capsys):
    assert export(results, tmp_path) == 0
    count = len(list_results(results))
    assert f"{5 * count} files" in capsys.readouterr().out
    place, subject, start = first_hemisphere(results)
    for level, surface in LEVELS.items():
        path = tmp_path / subject / "surf" / f"{start}{level}"
        points, triangles, about, stamp = nib.freesurfer.read_geometry(
            path, read_metadata=True, read_stamp=True
        )
        mesh = read_mesh(place.path(f"{surface}_surface"))
        np.testing.assert_allclose(points, mesh.points, atol=1e-5)
        np.testing.assert_array_equal(triangles, mesh.triangles)
        np.testing.assert_array_equal(about["cras"], 0)
        assert stamp == "made by hipsta_bids"
    sheet = read_sheet(place.path("sheet"))
    for title, column in (("thickness", "thickness"), ("curv", "curvature")):
        values = nib.freesurfer.read_morph_data(tmp_path / subject / "surf" / f"{start}{title}")
        np.testing.assert_allclose(values, np.nan_to_num(sheet[column].ravel()), atol=1e-5)


def test_freesurfer_surfaces_are_in_the_space_of_an_image(results, tmp_path):
    """By nibabel's own matrices of FreeSurfer's format, of an oblique image with unequal voxels."""
    turn = np.array([[0.0, -0.96, 0.28], [1, 0, 0], [0, 0.28, 0.96]])
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = turn * [0.7, 0.8, 1.2], [10, -40, 25]
    image = nib.MGHImage(np.zeros((90, 70, 50), np.uint8), affine)
    place, subject, start = first_hemisphere(results)
    nib.save(image, tmp_path / f"{subject}.mgz")
    pattern = tmp_path / "sub-{subject}.mgz"
    arguments = "--space-of", pattern, "--participant-label", place.name.subject
    assert export(results, tmp_path / "out", *arguments) == 0
    path = tmp_path / "out" / subject / "surf" / f"{start}outer"
    points, _, about = nib.freesurfer.read_geometry(path, read_metadata=True)
    to_scanner = image.affine @ np.linalg.inv(image.header.get_vox2ras_tkr())
    mesh = read_mesh(place.path("exterior_surface"))
    np.testing.assert_allclose(apply_affine(to_scanner, points), mesh.points, atol=1e-4)
    np.testing.assert_allclose(about["cras"], image.header["Pxyz_c"], atol=1e-4)
    np.testing.assert_array_equal(about["volume"], image.shape)


@pytest.mark.parametrize("kind", ["vtk", "ply"])
def test_surfaces_for_viewers_have_all_maps(results, tmp_path, kind):
    place, subject, _ = first_hemisphere(results)
    assert export(results, tmp_path, "--format", kind, "--participant-label", subject) == 0
    paths = sorted(tmp_path.iterdir())
    assert [path.name.rpartition("_")[2] for path in paths] == [f"{n}.{kind}" for n in LEVELS]
    mesh = meshio.read(paths[1])
    expected = read_mesh(place.path("midthickness_surface"))
    np.testing.assert_allclose(mesh.points, expected.points, atol=1e-5)
    thickness = read_sheet(place.path("sheet"))["thickness"].ravel()
    np.testing.assert_allclose(mesh.point_data["thickness"], thickness, atol=1e-5)


def test_wrong_use_is_one_line(results, tmp_path, capsys):
    cases = (
        ([tmp_path / "none", tmp_path], 65, "none: folder not found; check its name"),
        ([results, tmp_path, "--seg", "none"], 66, "check --seg and --region"),
        ([results, tmp_path, "--format", "vtk", "--space-of", "a{subject}.mgz"], 64, "omit it"),
        ([results, tmp_path, "--space-of", tmp_path / "{subject}.mgz"], 65, "file not found"),
    )
    for arguments, code, message in cases:
        assert export(*arguments) == code
        assert message in capsys.readouterr().err
