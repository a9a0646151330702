"""Figures of agreement between sessions and of sample sizes: rows of panels."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from hipsta_bids.extensions.trials.sizes import MOST_PARTICIPANTS
from hipsta_bids.group.output.color_bar import spanned
from hipsta_bids.group.output.panels import Row
from hipsta_bids.reports.cells import display_name, with_brackets
from hipsta_bids.stats.arrays import Float

#: Ticks of numbers of participants.
_COUNTS = tuple(n * 10**power for power in range(5) for n in (1, 2, 3, 5))


def agreement_rows(
    tables: Mapping[str, Mapping[str, Any]], measure: str, unit: str
) -> Iterator[Row]:
    """Show agreement between sessions, by the tables of both sides."""
    if tables:
        within, icc = (_values(tables, name) for name in ("sd_within", "icc"))
        title = "Within-subject SD"
        label = with_brackets(f"within-subject SD,\n{display_name(measure)}", unit)
        scale = spanned("magma", within)
        yield Row(kind="error", index=0, title=title, label=label, scale=scale, values=within)
        title = "ICC(2,1)"
        scale = {"cmap": "viridis", "vmin": 0.0, "vmax": 1.0}
        yield Row(kind="agreement", index=0, title=title, label=title, scale=scale, values=icc)


def size_rows(tables: Mapping[str, Mapping[str, Any]], measure: str, _: str) -> Iterator[Row]:
    """Show participants of each arm, or of the smaller one, by their logarithm."""
    values = {hemi: np.log10(n) for hemi, n in _values(tables, "per_arm").items()}
    if any(np.isfinite(n).any() for n in values.values()):
        scale = spanned("viridis_r", values)
        arm = (
            "of the smaller arm"
            if any("larger_arm" in table for table in tables.values())
            else "per arm"
        )
        beyond = any(
            (np.isnan(n) & (table["n"] > 0)).any()
            for n, table in zip(values.values(), tables.values(), strict=True)
        )
        ending = f" (gray: more than {MOST_PARTICIPANTS:,})" if beyond else ""
        ticks = [n for n in _COUNTS if scale["vmin"] <= np.log10(n) <= scale["vmax"]]
        yield Row(
            kind="size",
            index=0,
            title=f"Participants {arm}{ending}",
            label=f"participants {arm},\n{display_name(measure)}",
            scale=scale,
            values=values,
            ticks={float(np.log10(n)): f"{n:,}" for n in ticks},
        )


def _values(tables: Mapping[str, Mapping[str, Any]], column: str) -> dict[str, Float]:
    return {hemi: np.asarray(table[column], dtype=np.float64) for hemi, table in tables.items()}
