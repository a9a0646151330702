"""Layers: values of one measure at the points of one surface, whatever the surface is."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hipsta_bids.group.cohort.data import Cohort, hemispheres, summary_values
from hipsta_bids.group.stats.arrays import Float, Int, SideMaps

#: Surfaces: the sheet, and that of summary measures, which is one point. Those of other programs'
#: maps have names.
SHEET, SUMMARY = "", "summary"


@dataclass(frozen=True, eq=False, kw_only=True)
class Layer:
    """Values of one measure at the points of one surface in one hemisphere, or in both."""

    surface: str
    """``SHEET``, ``SUMMARY``, or the name of another program's maps."""
    hemi: str
    measure: str
    unit: str
    rows: Int
    """(rows,) rows of the cohort's table."""
    source: SideMaps | Float
    """Maps of this measure alone, or the values (rows, 1) of a summary measure."""

    @property
    def data(self) -> Float:
        """(rows, points), NaN where missing; registered anew each time in large cohorts."""
        if isinstance(self.source, SideMaps):
            return self.source.maps[self.measure].reshape(len(self.rows), -1)
        return self.source


def layers(
    cohorts: Mapping[str, Cohort],
    maps: Sequence[str],
    summaries: Sequence[str] | None,
    rows: Int | None = None,
) -> Iterator[Layer]:
    """Return layers of maps and then of summary measures.

    Parameters
    ----------
    cohorts : mapping of str to Cohort
        By surface.
    maps : sequence of str
        Maps of the sheet; those of other surfaces are all taken.
    summaries : sequence of str or None
        Summary measures of the sheet's cohort; ``None`` for all.
    rows : (rows,) array, optional
        Rows of the table whose summary measures are taken; by default all.
    """
    for surface, cohort in cohorts.items():
        names = maps if surface == SHEET else (surface,)
        for hemi, side in cohort.sides.items():
            for name in names:
                if name in side.maps:
                    yield Layer(
                        surface=surface,
                        hemi=hemi,
                        measure=name,
                        unit=cohort.units.get(name, "1"),
                        rows=side.rows,
                        source=side.only([name]),
                    )
    cohort = cohorts[SHEET]
    rows = np.arange(len(cohort.table)) if rows is None else rows
    for hemi in hemispheres(cohort):
        table = summary_values(cohort, hemi, summaries).iloc[rows]
        for name in table.columns:
            yield Layer(
                surface=SUMMARY,
                hemi=hemi,
                measure=str(name),
                unit=cohort.units.get(str(name), "1"),
                rows=rows,
                source=table[[name]].to_numpy(dtype=np.float64),
            )
