"""Maps on a triangle mesh, flat or folded."""

from typing import TYPE_CHECKING, Any

import numpy as np

from hipsta_bids.group_data import Float, Int, Mesh
from hipsta_bids.group_figures.panels import LABEL, SMALL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: A surface is flat if it is thinner than this share of its length.
_FLAT = 1e-3


def draw_mesh(
    axis: "Axes", mesh: Mesh, values: Float, colors: str, limits: tuple[float, float]
) -> Any:  # noqa: ANN401  (what colorbars take)
    """Draw one map, upright as sheets are.

    A flat surface is drawn in its own coordinates. HippUnfold's runs from anterior to posterior
    along x and from the subiculum to the dentate gyrus along y, so that x goes down and y to the
    right, as on a sheet. A folded surface is seen along its thinnest direction.

    Parameters
    ----------
    axis : Axes
    mesh : Mesh
        Surface.
    values : ndarray
        One number per vertex; triangles are drawn where all three are known.
    colors : str
        Color map.
    limits : (float, float)
        Values at its ends.
    """
    plane, triangles, words = _laid_out(mesh)
    flat = values.reshape(-1)
    known = np.isfinite(flat[triangles]).all(axis=1)
    axis.set_facecolor("0.92")
    axis.set_aspect("equal")
    axis.set_xlabel(words[0], fontsize=LABEL)
    axis.set_ylabel(words[1], fontsize=LABEL)
    axis.tick_params(labelsize=SMALL)
    (left, bottom), (right, top) = plane.min(axis=0), plane.max(axis=0)
    axis.set_xlim(left, right)
    axis.set_ylim(*((top, bottom) if words[1].startswith("x") else (bottom, top)))
    # One invisible triangle carries the colors if nothing is known.
    some = triangles[known] if known.any() else triangles[:1]
    return axis.tripcolor(
        plane[:, 0],
        plane[:, 1],
        some,
        facecolors=np.nan_to_num(flat[some].mean(axis=1)),
        cmap=colors,
        vmin=limits[0],
        vmax=limits[1],
        edgecolors="none",
        rasterized=True,
        visible=bool(known.any()),
    )


def _laid_out(mesh: Mesh) -> tuple[Float, Int, tuple[str, str]]:
    """Positions in the plane, triangles from back to front, and what the axes are."""
    centered = mesh.points - mesh.points.mean(axis=0)
    reach = np.ptp(mesh.points, axis=0)
    if reach[2] <= _FLAT * reach.max():
        names = ("x of the surface", "y of the surface")
        if reach[0] > reach[1]:
            return mesh.points[:, [1, 0]], mesh.triangles, (names[1], names[0])
        return mesh.points[:, :2], mesh.triangles, names
    axes = np.linalg.svd(centered, full_matrices=False)[2]
    turned = centered @ axes.T
    order = np.argsort(turned[mesh.triangles, 2].mean(axis=1))
    return turned[:, [1, 0]], mesh.triangles[order], ("second axis", "longest axis")
