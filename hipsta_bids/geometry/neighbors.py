"""Cortex beside the hippocampal body: the sheet's way on beyond the subiculum."""

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.artifacts import Float, LabelVolume
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.ends import EndPlanes
from hipsta_bids.schemes import Tissue, for_region
from hipsta_bids.settings import BodySettings


def join_cortex(
    volume: LabelVolume, hippocampal: NDArray[np.uint8], region: str
) -> NDArray[np.uint8]:
    """Add the neighboring cortex to the hippocampal sheet, or take it alone.

    Parameters
    ----------
    volume : LabelVolume
    hippocampal : (I, J, K) uint8
        Tissue of the hippocampal sheet; 0 elsewhere.
    region : {"extended", "entorhinal"}

    Returns
    -------
    (I, J, K) uint8
        Tissue of the region's sheet; 0 elsewhere.

    Raises
    ------
    SchemeError
        ``no-cortex-labels`` if the protocol has no neighboring cortex.
    GeometryError
        ``no-cortex-labels`` if nothing has these labels, ``edited-mask-region`` if there is an
        edited mask, which is one of the body.
    """
    kinds = [t for t in for_region(volume.scheme, region).sheet if t in volume.scheme.neighbors]
    if volume.edited_mask is not None:
        raise GeometryError(
            f"region {region}: an edited mask is about the body, not about the cortex beside it; "
            "edit the labels instead (desc-edited_dseg)",
            reason="edited-mask-region",
        )
    cortex = np.isin(volume.tissue, kinds)
    if not cortex.any():
        raise GeometryError(
            f"region {region}: no voxel is labeled {_names(kinds)}; measure the body, or label the "
            "cortex beside it",
            reason="no-cortex-labels",
        )
    kept = hippocampal if region == "extended" else np.zeros_like(hippocampal)
    return np.where(cortex, volume.tissue, kept).astype(np.uint8)


def check_reach(
    points: Float, tissue: NDArray[np.uint8], ends: EndPlanes, settings: BodySettings
) -> None:
    """Refuse cortex that does not reach from one end plane to the other.

    Parameters
    ----------
    points : (N, 3) array
        The region between the end planes, RAS mm.
    tissue : (N,) array of uint8
    ends : EndPlanes
    settings : BodySettings

    Raises
    ------
    GeometryError
        ``cortex-incomplete``.
    """
    cortex = tissue > Tissue.HIPPOCAMPUS
    below = ends.height(points[cortex], "posterior")
    above = -ends.height(points[cortex], "anterior")
    length = ends.length(points)
    # Levels are as long as a voxel, so that each level with labels has the center of one.
    count = max(int(length / (2 * ends.half_slice)), 1)
    level = np.minimum((count * below / (below + above)).astype(int), count - 1)
    share = len(np.unique(level)) / count
    if share < settings.min_cortex_reach:
        raise GeometryError(
            f"region {settings.region}: the cortex is labeled along {share * length:.1f} mm of the "
            f"{length:.1f} mm between the end planes: measure the body, or label the cortex beside "
            "all of it",
            reason="cortex-incomplete",
        )


def _names(kinds: list[Tissue]) -> str:
    return " or ".join(kind.name for kind in kinds)
