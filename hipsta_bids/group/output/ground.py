"""What maps lie on: the sheet, its average surface, and surfaces of other programs."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.analyses import GroupResults, records
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.io import gifti
from hipsta_bids.stats.arrays import Float, Int
from hipsta_bids.stats.glm import FittedMaps
from hipsta_bids.types import Mesh

_HALF = 0.5  # of a cell


@dataclass(frozen=True, eq=False, kw_only=True)
class Ground:
    """What the maps of one side lie on."""

    x: Float
    """Coordinates of the nodes of the sheet."""
    y: Float
    subfield: Int
    """(x, y) most frequent subfield, position in ``names``; -1 where there is none."""
    names: tuple[str, ...]
    mesh: Mesh | None = None
    """Surface of maps of other programs."""
    surface: Mesh | None = None
    """Middle surface of the sheet, on which its maps are drawn besides."""

    @cached_property
    def borders(self) -> list[Float]:
        """(N, 2) lines between subfields on the sheet, through the middles between nodes."""
        from contourpy import contour_generator  # noqa: PLC0415  (slow to load)

        lines, edges = list[Float](), (beyond(self.x), beyond(self.y))
        for number in range(len(self.names)):
            area = np.pad(self.subfield == number, 1, mode="edge").T.astype(np.float64)
            lines += [np.asarray(line) for line in contour_generator(*edges, area).lines(_HALF)]
        return lines

    @property
    def unfolded(self) -> bool:
        """Whether maps lie on a plane: of the sheet, or of other programs."""
        return self.mesh is None or self.mesh.flat

    @property
    def folded(self) -> Mesh | None:
        """Return the surface in three dimensions."""
        return self.mesh if self.mesh is not None and not self.mesh.flat else self.surface


def grounds_of(cohort: Cohort, sides: Mapping[str, FittedMaps]) -> dict[str, Ground]:
    """Return what the maps of each side lie on, without average surfaces."""
    return {
        hemi: Ground(
            x=cohort.x,
            y=cohort.y,
            subfield=fitted.subfield,
            names=fitted.maps.names,
            mesh=fitted.maps.mesh,
        )
        for hemi, fitted in sides.items()
    }


def read_grounds(results: GroupResults, measure: str) -> dict[str, Ground]:
    """Read what the maps of a measure lie on, by side."""
    maps, grounds = results.table("maps"), {}
    for row in records(maps[maps["measure"] == measure].drop_duplicates("hemi")):
        points, hemi = results.table(str(row["file"])), str(row["hemi"])
        words = [word if isinstance(word, str) else "" for word in points["subfield"]]
        names = tuple(name for name in dict.fromkeys(words) if name)
        subfield = np.array([names.index(word) if word else -1 for word in words])
        side = hemi if hemi in {"L", "R"} else "L"  # what is made of both lies on the left
        if "vertex" in points:
            mesh, ends = _read_mesh(results, hemi, points), np.array([-1.0, 1.0])
            grounds[hemi] = Ground(
                x=ends, y=ends, subfield=subfield[:, None], names=names, mesh=mesh
            )
            continue
        shape = int(points["node_x"].max()), int(points["node_y"].max())
        path = results.folder / f"hemi-{side}_desc-average_midthickness.surf.gii"
        x, y = (points[axis].to_numpy(np.float64).reshape(shape) for axis in "xy")
        grounds[hemi] = Ground(
            x=x[:, 0],
            y=y[0],
            subfield=subfield.reshape(shape),
            names=names,
            surface=gifti.read_mesh(path) if path.exists() else None,
        )
    return grounds


def _read_mesh(results: GroupResults, hemi: str, points: pd.DataFrame) -> Mesh:
    """Read the surface whose vertices the points of a table are."""
    places = points[[f"surface_{axis}" for axis in "xyz"]].to_numpy(np.float64)
    for path in sorted(results.folder.glob(f"hemi-{hemi}_space-*_midthickness.surf.gii")):
        mesh = gifti.read_mesh(path)
        if mesh.points.shape == places.shape and np.allclose(mesh.points, places, atol=1e-3):
            return mesh
    return Mesh(points=places, triangles=np.zeros((0, 3), dtype=np.int64))


def middles_of(ground: Ground) -> dict[str, float]:
    """Find where subfields are on a sheet, as shares of its width from medial; in their order."""
    places = {
        name: float((np.nonzero(ground.subfield == number)[0].mean() + _HALF) / len(ground.x))
        for number, name in enumerate(ground.names)
        if (ground.subfield == number).any()
    }
    return dict(sorted(places.items(), key=lambda pair: pair[1]))


def beyond(nodes: Float) -> Float:
    """Add the outer edges of the first and of the last cell to the nodes."""
    half = (nodes[1] - nodes[0]) / 2
    return np.concatenate([[nodes[0] - half], nodes, [nodes[-1] + half]])
