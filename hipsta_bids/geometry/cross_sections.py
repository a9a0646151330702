"""Cross-sections of the body: what is measured where y is constant (Diers et al. 2023, 2.2)."""

from dataclasses import dataclass

import numpy as np

from hipsta_bids.artifacts import Float, Sheet
from hipsta_bids.geometry.shape_lengths import extent_x, wall_length
from hipsta_bids.settings import MeasureSettings


@dataclass(frozen=True, eq=False, kw_only=True)
class CrossSections:
    """One value per cross-section, all (Ny,), from posterior to anterior."""

    position: Float
    """Distance from the posterior end plane along the mid-surface, mean over x, mm."""
    interior: Float
    """Length of the interior wall, mm."""
    middle: Float
    """Length of the mid-line, mm."""
    exterior: Float
    """Length of the exterior wall, mm."""
    area: Float
    """mm2."""
    thickness: Float
    """Mean over the columns of the section, mm."""

    @property
    def circumference(self) -> Float:
        """Length of both walls, mm."""
        return self.interior + self.exterior

    @property
    def ratio(self) -> Float:
        """Interior over exterior length."""
        return self.interior / self.exterior

    @property
    def shape_index(self) -> Float:
        """Circumference over area, 1/mm; 2 / thickness in a sheet of even thickness."""
        return self.circumference / self.area

    def mean(self, values: Float) -> float:
        """Mean of values (Ny,) over the body; every millimeter of its length counts the same."""
        return float(np.trapezoid(values, self.position) / np.ptp(self.position))


def cut_sections(whole: Sheet, thickness: Float, settings: MeasureSettings) -> CrossSections:
    """Measure the cross-sections of a body.

    Parameters
    ----------
    whole : Sheet
        From rim to rim and wall to wall.
    thickness : (Ny,) array
        Mean of each section, mm.
    settings : MeasureSettings

    Returns
    -------
    CrossSections
    """
    middle = whole.points[:, :, whole.middle]
    steps = np.linalg.norm(np.diff(middle, axis=1), axis=-1).mean(axis=0)
    return CrossSections(
        position=np.concatenate([[0.0], steps.cumsum()]),
        interior=wall_length(whole, 0, settings),
        middle=extent_x(whole),
        exterior=wall_length(whole, -1, settings),
        area=section_area(whole),
        thickness=thickness,
    )


def section_area(whole: Sheet) -> Float:
    """Area of each cross-section, (Ny,), mm2.

    Half the length of the sum of the cells' diagonals' cross products: in a plane the area of the
    polygon round the section, whatever its cells do next to rounded rims. What chords cut off goes
    with the square of their length; it is extrapolated from every second one (Richardson 1911).
    """
    area = _polygon_area(whole.points)
    if whole.points.shape[0] % 2 == 0:  # the last line would be left out
        return area
    return area + (area - _polygon_area(whole.points[::2])) / 3


def _polygon_area(points: Float) -> Float:
    p = np.moveaxis(points, 1, 0)
    first, second = p[:, 1:, 1:] - p[:, :-1, :-1], p[:, 1:, :-1] - p[:, :-1, 1:]
    return np.asarray(0.5 * np.linalg.norm(np.cross(first, second).sum(axis=(1, 2)), axis=-1))
