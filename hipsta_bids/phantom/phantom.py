"""The phantom itself: a shape that can be drawn and whose truth is known."""

import numpy as np
from numpy.typing import ArrayLike

from hipsta_bids.phantom.labels import draw, make_grid, subfield_spans, tissue_at
from hipsta_bids.phantom.shape import Body, PhantomSpec
from hipsta_bids.phantom.truth import (
    SURFACES,
    PhantomTruth,
    curvatures,
    line_lengths,
    summarize,
)
from hipsta_bids.protocols.protocol import Protocol, Tissue
from hipsta_bids.types import Float, LabelVolume


class Phantom:
    """An analytic hippocampal body with exact truth."""

    def __init__(self, spec: PhantomSpec) -> None:
        self.spec = spec
        self.body = Body(spec)

    def label_volume(
        self,
        protocol: Protocol,
        *,
        hemi: str = "L",
        voxel_size: tuple[float, float, float] = (0.4, 0.4, 0.4),
        pose: Float | None = None,
        axes: str = "RAS",
        grid_rotation: Float | None = None,
        supersample: int | tuple[int, int, int] = 1,
        border: float = 3.0,
    ) -> LabelVolume:
        """Draw the phantom as a segmentation.

        Parameters
        ----------
        voxel_size
            mm along the three voxel axes.
        pose
            (4, 4) rigid motion of the phantom, RAS mm.
        axes
            Where the voxel axes point, such as ``RAS`` or ``LIA``.
        grid_rotation
            (3, 3) rotation of the voxel grid.
        supersample
            Points per voxel and axis that vote for its label.
        border
            mm of background on every side.
        """
        grid = make_grid(
            self._outline(hemi, pose),
            voxel_size=voxel_size,
            axes=axes,
            rotation=grid_rotation,
            border=border,
        )
        labels = draw(self.body, grid, protocol, hemi=hemi, pose=pose, supersample=supersample)
        tissue = np.array([0, *(label.tissue for label in protocol.labels)], dtype=np.uint8)
        part = np.array([0, *(label.part for label in protocol.labels)], dtype=np.uint8)
        return LabelVolume(
            tissue=tissue[labels], part=part[labels], affine=grid.affine, protocol=protocol
        )

    def truth(
        self, u: ArrayLike, v: ArrayLike, *, hemi: str = "L", pose: Float | None = None
    ) -> PhantomTruth:
        """Return what a perfect method would measure at positions (u, v)."""
        x, y = np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64))
        curved = {name: curvatures(self.body, x, y, at=at) for name, at in SURFACES.items()}
        extent_x, extent_y = line_lengths(self.body, x, y)
        return PhantomTruth(
            thickness=self.body.thickness(x, y),
            points=self.body.place(x, y, 0.0, hemi=hemi, pose=pose),
            curvature_interior=curved["interior"][0],
            curvature=curved["mid"][0],
            curvature_exterior=curved["exterior"][0],
            gaussian_curvature=curved["mid"][1],
            gaussian_curvature_interior=curved["interior"][1],
            gaussian_curvature_exterior=curved["exterior"][1],
            extent_x=extent_x,
            extent_y=extent_y,
            subfield=tissue_at(self.spec, x, y),
            summary=summarize(self.body),
        )

    @property
    def regions(self) -> tuple[str, ...]:
        """Regions that can be measured in it."""
        return ("body", "extended", "entorhinal") if self.spec.cortex else ("body",)

    def region_summary(self, region: str) -> dict[str, float]:
        """Return what a perfect method would measure in a region as a whole."""
        border = self.spec.cortex_share
        border += self.spec.offset if border else 0.0
        spans = {"body": (border, 1.0), "extended": (0.0, 1.0), "entorhinal": (0.0, border)}
        return summarize(self.body, span=spans[region])

    def subfield_summary(self, protocol: Protocol) -> dict[Tissue, dict[str, float]]:
        """Return what a perfect method would measure in each subfield that a protocol draws."""
        share, shift = self.spec.cortex_share, self.spec.offset
        return {
            tissue: summarize(
                self.body,
                span=(
                    share + (1.0 - share) * start + (shift if start or share else 0.0),
                    share + (1.0 - share) * end + (shift if end < 1.0 else 0.0),
                ),
            )
            for tissue, (start, end) in subfield_spans(protocol).items()
        }

    def _outline(self, hemi: str, pose: Float | None) -> Float:
        """Points (N, 3), RAS mm, that span head, body and tail with all they enclose."""
        beyond = self.spec.end_length / self.spec.length
        half = self.body.thickest / 2.0
        u, v, n = np.meshgrid(
            np.linspace(0.0, 1.0, 101),
            np.linspace(-beyond, 1.0 + beyond, 21),
            [-half - self.spec.interior_depth, half],
            indexing="ij",
        )
        return self.body.place(u, v, n, hemi=hemi, pose=pose).reshape(-1, 3)
