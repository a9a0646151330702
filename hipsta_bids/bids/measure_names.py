"""What the names of measures stand for: maps of the sheet, sampled maps, or summary measures."""

import difflib
from collections.abc import Mapping, Sequence

from hipsta_bids.bids import files
from hipsta_bids.bids.group_inputs import SheetRecord
from hipsta_bids.errors import InputError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.group_data import Measures, SideMaps

#: What registration rests on.
CURVATURE = "curvature"
#: Maps that are analyzed unless others are asked for.
DEFAULT = ("thickness", CURVATURE)
#: Names of all maps in the sheet tables.
SHEET_MAPS = tuple(row.name for row in MAPS)
#: What begins the names of volumes that other programs give.
VOLUME = "volume_"

_SHOWN = 12


def choose_measures(
    wanted: Sequence[str], records: Sequence[SheetRecord], others: Sequence[str] = ()
) -> Measures:
    """Tell maps from summary measures.

    Parameters
    ----------
    wanted : sequence of str
        Names; none for the default.
    records : sequence of SheetRecord
        Hemispheres, to see what was measured and sampled.
    others : sequence of str, optional
        Maps that do not come from the sheets.

    Raises
    ------
    InputError
        If a name is neither.
    """
    own = DEFAULT if records else ()
    if not wanted:
        return Measures(maps=(*own, *others))
    summaries = _summary_names(records)
    maps, numbers = [], []
    for name in wanted:
        if name in others or (records and name in SHEET_MAPS) or _is_sampled(name, records):
            maps.append(name)
        elif name in summaries or name.startswith(VOLUME):
            numbers.append(name)
        else:
            known = [*(SHEET_MAPS if records else ()), *others, *_sampled(records), *summaries]
            near = difflib.get_close_matches(name, known, n=1)
            more = " ..." if len(known) > _SHOWN else ""
            hint = (
                f"did you mean {near[0]}?"
                if near
                else f"there are {', '.join(known[:_SHOWN])}{more}"
            )
            raise InputError(f"no measure is called {name!r}; {hint}", reason="unknown-measure")
    return Measures(maps=tuple(maps), summaries=tuple(numbers) or None)


def check_summaries(measures: Measures, sides: Mapping[str, SideMaps]) -> None:
    """Refuse summary measures that no hemisphere has.

    Raises
    ------
    InputError
        Names the first.
    """
    known = sorted({str(name) for side in sides.values() for name in side.summary.columns})
    for name in measures.summaries or ():
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]}?" if near else "are its tables there?"
            raise InputError(f"no measure is called {name!r}; {hint}", reason="unknown-measure")


def sampled_desc(name: str) -> str:
    """Name of the sampled map that a column belongs to: ``bold_3`` is the third of ``bold``."""
    return name.partition("_")[0]


def _is_sampled(name: str, records: Sequence[SheetRecord]) -> bool:
    desc = sampled_desc(name)
    return any(record.place.path("map_table", desc).is_file() for record in records)


def _sampled(records: Sequence[SheetRecord]) -> list[str]:
    """Names of maps that were sampled, as far as the first hemisphere has them."""
    if not records:
        return []
    pattern = records[0].place.path("map_table", "*")
    start, _, end = pattern.name.partition("*")
    found = pattern.parent.glob(pattern.name)
    return sorted(path.name.removeprefix(start).removesuffix(end) for path in found)


def _summary_names(records: Sequence[SheetRecord]) -> tuple[str, ...]:
    if not records:
        return ()
    rows: Sequence[Mapping[str, str]] = files.read_tsv(records[0].place.path("summary"))
    return tuple(rows[0]) if rows else ()
