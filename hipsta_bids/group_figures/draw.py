"""Which figures a model has."""

from collections.abc import Iterator, Mapping

from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.shapes import AverageShape
from hipsta_bids.group_data import Cohort
from hipsta_bids.group_figures.classifiers import draw_calibration, draw_roc
from hipsta_bids.group_figures.curves import draw_profiles, draw_warps
from hipsta_bids.group_figures.panels import Drawing, encode
from hipsta_bids.group_figures.sections import draw_sections
from hipsta_bids.group_figures.sheets import draw_contrasts, draw_means


def draw_figures(
    cohort: Cohort, analysis: Analysis, shapes: Mapping[str, AverageShape]
) -> Iterator[Drawing]:
    """Draw all figures of one model.

    Parameters
    ----------
    cohort : Cohort
        What was analyzed.
    analysis : Analysis
        Results.
    shapes : mapping of str to AverageShape
        By hemisphere; those whose surfaces are known.

    Yields
    ------
    Drawing
    """
    for measure in dict.fromkeys(m for one in analysis.fitted.values() for m in one.fits):
        yield encode(f"{measure}_means", draw_means(cohort, analysis, measure))
        if any(one.fits[measure].tests for one in analysis.fitted.values() if measure in one.fits):
            yield encode(f"{measure}_contrasts", draw_contrasts(cohort, analysis, measure))
    if analysis.sides:
        yield encode("profiles", draw_profiles(cohort, analysis))
    if (
        analysis.groups is not None
        and analysis.sides
        and all(side.registration.template is not None for side in analysis.sides.values())
    ):
        yield encode("warps", draw_warps(cohort, analysis))
    if shapes:
        yield encode("sections", draw_sections(cohort, analysis, shapes))
    if analysis.pairs:
        yield encode("roc", draw_roc(analysis))
        yield encode("calibration", draw_calibration(analysis))
