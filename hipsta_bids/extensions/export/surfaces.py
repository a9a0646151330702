"""Surfaces and maps of an output dataset for other programs: FreeSurfer, VTK and PLY.

FreeSurfer's surfaces are in the coordinates of an image (``tkregister``): voxel spacing and size of
the image, its center at the origin. See the coordinate systems of FreeSurfer's wiki
(https://surfer.nmr.mgh.harvard.edu/fswiki/CoordinateSystems).
"""

import tempfile
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from nibabel.freesurfer import io as freesurfer
from numpy.typing import NDArray

from hipsta_bids.derivatives.results import ResultPlace, list_results, read_sheet
from hipsta_bids.errors import NothingToDoError, UsageError
from hipsta_bids.inputs.maps import check_pattern, fill
from hipsta_bids.io import files, gifti
from hipsta_bids.io.volumes import read_grid
from hipsta_bids.types import Float

#: Names of surfaces in files, and in an output dataset.
_SURFACES = {"inner": "interior", "mid": "midthickness", "outer": "exterior"}
#: Names of maps in FreeSurfer's files, and in the sheet.
_MAPS = {"thickness": "thickness", "curv": "curvature"}
_ORIGIN = "made by hipsta_bids"  # in place of the user and the time
#: An image whose coordinates are the scanner's: 256 voxels of 1 mm around the origin.
_SCANNER = (
    np.array([[-1.0, 0, 0, 128], [0, 0, 1, -128], [0, -1, 0, 128], [0, 0, 0, 1]]),
    (256, 256, 256),
)


def export_surfaces(
    out_dir: Path,
    folder: Path,
    kind: str,
    *,
    protocol: str | None = None,
    region: str = "body",
    participants: Sequence[str] = (),
    image: str = "",
) -> list[Path]:
    """Write the surfaces of each hemisphere that was measured, and thickness and curvature.

    ``image`` is a path with ``{subject}`` and perhaps ``{session}``: the image in whose coordinates
    FreeSurfer's surfaces are written; else these are the scanner's.
    """
    if image:
        if kind != "freesurfer":
            raise UsageError("--space-of: only FreeSurfer's surfaces need an image; omit it")
        check_pattern("--space-of", "", image)
    place_of: dict[Path, ResultPlace] = {}
    for place in list_results(out_dir):
        name = place.name
        is_wanted = name.region == region and protocol in {None, name.seg}
        if not is_wanted or (participants and name.subject not in participants):
            continue
        if not place.path("sheet").is_file():  # failed
            continue
        space = Path(fill(image, name.subject, name.session, name.hemi)) if image else None
        for path, content in _files(place, folder, kind, space):
            if path in place_of:
                raise UsageError(
                    f"{path}: {place_of[path].name.seg} and {name.seg} have one name; choose --seg"
                )
            place_of[path] = place
            files.write_bytes(path, content)
    if not place_of:
        raise NothingToDoError(f"{out_dir}: no measured hemisphere; check --seg and --region")
    return list(place_of)


def _files(
    place: ResultPlace, folder: Path, kind: str, image: Path | None
) -> Iterator[tuple[Path, bytes]]:
    """Encode the files of one hemisphere."""
    maps = read_sheet(place.path("sheet"))
    surfaces = {
        level: gifti.read_mesh(place.path(f"{surface}_surface"))
        for level, surface in _SURFACES.items()
    }
    name = place.name
    if kind != "freesurfer":
        for level, mesh in surfaces.items():
            path = folder / f"{name.stem}_{name.protocol}_{level}.{kind}"
            yield path, gifti.encode_surface(path.suffix, mesh, maps)
        return
    matrix, space = _scanner_to_surface(image)
    visit = f"sub-{name.subject}" + (f"_ses-{name.session}" if name.session else "")
    start = folder / visit / "surf" / f"{name.hemi.lower()}h.hippo_"
    for level, mesh in surfaces.items():
        points = mesh.points @ matrix[:3, :3].T + matrix[:3, 3]
        yield Path(f"{start}{level}"), _geometry(points, mesh.triangles, space)
    for title, column in _MAPS.items():
        content = BytesIO()
        # FreeSurfer has no number for missing values: they are 0 in its own files.
        freesurfer.write_morph_data(content, np.nan_to_num(maps[column].ravel()))
        yield Path(f"{start}{title}"), content.getvalue()


def _geometry(points: Float, triangles: NDArray[np.int64], space: dict[str, object]) -> bytes:
    """Encode a surface; nibabel writes to paths only."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "surface"
        freesurfer.write_geometry(path, points, triangles, _ORIGIN, volume_info=space)
        return path.read_bytes()


def _scanner_to_surface(image: Path | None) -> tuple[Float, dict[str, object]]:
    """Compute the matrix (4, 4) from scanner RAS to surface RAS, and FreeSurfer's description."""
    affine, shape = _SCANNER if image is None else read_grid(image)[::-1]
    size = np.linalg.norm(affine[:3, :3], axis=0)
    axes, half = affine[:3, :3] / size, np.array(shape[:3]) / 2
    center = affine[:3] @ [*half, 1]
    turn = np.array([[-1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    to_surface = np.eye(4)
    to_surface[:3, :3] = turn @ np.linalg.inv(axes)
    to_surface[:3, 3] = -to_surface[:3, :3] @ center
    space = {
        "head": [2, 0, 20],
        "valid": "1  # volume info valid",
        "filename": "none" if image is None else image.name,
        "volume": np.array(shape[:3]),
        "voxelsize": size,
        **dict(zip(("xras", "yras", "zras"), axes.T, strict=True)),
        "cras": center,
    }
    return to_surface, space
