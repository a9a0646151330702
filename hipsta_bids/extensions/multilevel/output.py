"""What random intercepts add to results: a table of variances, and the text of methods."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np
import pandas as pd

from hipsta_bids.extensions.multilevel import EXTENSION
from hipsta_bids.extensions.multilevel.rows import FEW_LEVELS
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.output.citations import escaped
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.output.tables import read_columns


def tables(
    cohort: Cohort, analysis: Analysis, prefix: str
) -> Iterator[tuple[str, pd.DataFrame, Mapping[str, str]]]:
    """Table of the variances between and within levels, with the meaning of its columns."""
    formula, count = analysis.model.formula, len(np.unique(analysis.design.random))
    # Each entry has the variances of one measure: of all points, or of a summary measure.
    fits = [
        ("map", hemi, formula, name, fit, slice(None))
        for hemi, fitted in analysis.fitted.items()
        for name, fit in fitted.fits.items()
    ]
    fits += [
        ("summary", hemi, formula, name, fit, slice(i, i + 1))
        for (hemi, formula), (names, fit, _) in analysis.measures.items()
        for i, name in enumerate(names)
    ]
    rows = []
    for kind, hemi, formula, name, fit, part in fits:
        between, within = (fit.variances[key][part] for key in ("participant", "residual"))
        table = pd.DataFrame({"between": between, "within": within}).dropna()
        rows.append(
            {
                "measure": name,
                "unit": cohort.units.get(name, "1"),
                "kind": kind,
                "hemi": hemi,
                "model": replace(analysis.model, formula=formula).text,
                "levels": count,
                "level_sd": np.sqrt(table["between"]).median(),
                "residual_sd": np.sqrt(table["within"]).median(),
                "level_icc": (table["between"] / table.sum(axis=1)).median(),
                "level_zero": (table["between"] == 0).mean(),
            }
        )
    if rows:
        yield f"{prefix}random", pd.DataFrame(rows), read_columns(EXTENSION.package)


def methods(analysis: Analysis, cite: Callable[[str], str]) -> Iterator[str]:
    """Write which intercepts were random, and how tests allowed for them."""
    counts = np.unique(analysis.design.random, return_counts=True)[1]
    text = (
        f"The {len(counts)} levels of {escaped(analysis.model.random)}, with {counts.min()} to"
        f" {counts.max()} participants, had random intercepts. The mixed model was estimated by"
        f" restricted maximum likelihood. Degrees of freedom were Satterthwaite's {cite('mixed')}."
    )
    if any(contrast.n_rows > 1 for contrast in analysis.design.contrasts):
        text += f" Contrasts of several rows were tested by F {cite('fai')}."
    if len(counts) < FEW_LEVELS:
        text += f" Of fewer than {FEW_LEVELS} levels, the variance between them is uncertain."
    yield text
