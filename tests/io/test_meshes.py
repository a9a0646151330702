import meshio
import numpy as np
import pytest

from hipsta_bids.errors import InputError, MissingFileError, UsageError
from hipsta_bids.io.gifti import ENDINGS, read_surface, sheet_triangles, write_surface
from hipsta_bids.types import Mesh

NX, NY = 5, 4


def surface(*, missing=()):
    points = np.random.default_rng(0).normal(30.0, 9.0, (NX * NY, 3))
    points[list(missing)] = np.nan
    return Mesh(points=points, triangles=sheet_triangles(NX, NY).astype(np.int64))


@pytest.mark.parametrize("ending", ENDINGS)
def test_surfaces_come_back(tmp_path, ending):
    path, mesh = tmp_path / f"average{ending}", surface()
    thickness = np.linspace(1.0, 2.0, NX * NY)
    thickness[3] = np.nan
    write_surface(path, mesh, {"thickness": thickness.reshape(NX, NY)})
    found = read_surface(path)
    np.testing.assert_array_equal(found.points, mesh.points)  # double precision in all formats
    np.testing.assert_array_equal(found.triangles, mesh.triangles)
    if ending != ".obj":
        np.testing.assert_array_equal(meshio.read(path).point_data["thickness"], thickness)


@pytest.mark.parametrize("ending", ENDINGS)
def test_missing_points_are_at_the_center_of_no_triangle(tmp_path, ending):
    path, mesh = tmp_path / f"average{ending}", surface(missing=[6])
    write_surface(path, mesh, {})
    found = read_surface(path)
    np.testing.assert_allclose(found.points[6], np.nanmean(mesh.points, axis=0), rtol=1e-12)
    np.testing.assert_array_equal(
        found.triangles, mesh.triangles[~(mesh.triangles == 6).any(axis=1)]
    )


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("content", [b"", b"ply\nformat", b"v 1 2\nf 7 8 9\n", bytes(range(256))])
def test_damaged_files_are_refused(tmp_path, ending, content):
    path = tmp_path / f"average{ending}"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"write it again"):
        read_surface(path)


@pytest.mark.parametrize("ending", [*ENDINGS, ".surf.gii"])
def test_missing_files_are_not_found(tmp_path, ending):
    with pytest.raises(MissingFileError, match="file not found; check its name"):
        read_surface(tmp_path / f"average{ending}")


def test_other_endings_are_refused(tmp_path):
    with pytest.raises(UsageError, match=r"surfaces end with \.vtk, \.ply, \.obj"):
        write_surface(tmp_path / "average.stl", surface(), {})
