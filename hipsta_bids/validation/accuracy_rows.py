"""Which phantoms the accuracy suite measures, in which voxels, and what is asked of each."""

from dataclasses import dataclass

from hipsta_bids.phantom import PhantomSpec

TILT = 10.0
"""Degrees by which tilted slices miss the perpendicular to the long axis."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row of the accuracy table."""

    spec: PhantomSpec
    voxel_size: tuple[float, float, float]
    bias: float
    """mm, target."""
    sd: float
    """mm, target."""
    tilt: float | None = None
    """Degrees; None for isotropic voxels, which are turned at random."""

    @property
    def name(self) -> str:
        """For people."""
        spec = self.spec
        varied = f", ±{spec.variation:.0%}" if spec.variation else ""
        tilted = f", tilted by {self.tilt:g}°" if self.tilt else ""
        return f"{spec.kind} {spec.thickness:.1f} mm{varied}{tilted}"

    @property
    def voxels(self) -> str:
        """Voxel size for people."""
        x, y, z = self.voxel_size
        return f"{x:g} iso" if x == y == z else f"{x:g} x {y:g} x {z:g}"


def _rows() -> tuple[Row, ...]:
    iso = (0.4, 0.4, 0.4)
    thin = PhantomSpec(kind="spiral", thickness=1.2)
    fine = [
        *(
            Row(spec=PhantomSpec(kind=kind, thickness=2.0), voxel_size=iso, bias=0.015, sd=0.04)
            for kind in ("arc", "spiral", "tight")
        ),
        Row(spec=thin, voxel_size=iso, bias=0.02, sd=0.05),
    ]
    varied = PhantomSpec(kind="spiral", thickness=2.0, variation=0.3)
    tight = PhantomSpec(kind="tight", thickness=1.6)
    thick = [
        row
        for tilt in (0.0, TILT)
        for row in (
            Row(spec=varied, voxel_size=(0.4, 0.4, 2.0), bias=0.015, sd=0.065, tilt=tilt),
            Row(spec=thin, voxel_size=(0.4, 0.4, 2.0), bias=0.02, sd=0.05, tilt=tilt),
            Row(spec=tight, voxel_size=(0.5, 0.5, 1.5), bias=0.03, sd=0.09, tilt=tilt),
        )
    ]
    return (*fine, *thick)


ROWS = _rows()
