"""The line of an analysis, from sheets and covariates to results."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from hipsta_bids.errors import ModelError
from hipsta_bids.group import model as modeling
from hipsta_bids.group.cohort import data
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.output.steps import extend, plan_blocks
from hipsta_bids.group.questions.aligning import register_side
from hipsta_bids.group.questions.summaries import classify_groups, fit_summaries
from hipsta_bids.group.request import Request
from hipsta_bids.joints import find_permuting
from hipsta_bids.progress import each, tell
from hipsta_bids.stats import inference
from hipsta_bids.stats.design import Design, build_design
from hipsta_bids.stats.formula import listed
from hipsta_bids.stats.glm import RowModel, fit_maps, with_mean
from hipsta_bids.types import PARTICIPANT

#: Measures that are made of a map, besides the ones that begin with its name.
CONTAINS = {"thickness": ("volume", "surface_volume_ratio")}


def analyze_cohort(request: Request) -> Analysis:
    """Register, fit a model at each point and to each summary measure, and classify.

    Parameters
    ----------
    request : Request
        Cohort, model and settings, planned by :func:`hipsta_bids.group.output.steps.plan_steps`.

    Returns
    -------
    Analysis
        The request with results: registration, maps and summary measures of fits, classification.

    Raises
    ------
    ModelError
        If the model cannot be fitted to these data.
    """
    analysis = design(request)
    for step in LINE:
        analysis = step(analysis)
    return analysis


def analyze_points(cohort: data.Cohort, analysis: Analysis) -> Analysis:
    """Fit the model of an analysis to further maps, which are not registered."""
    maps = tuple(dict.fromkeys(name for side in cohort.sides.values() for name in side.maps))
    measures = data.Measures(maps=maps, summaries=())
    of_points = Analysis(
        request=replace(analysis.request, cohort=cohort, measures=measures),
        design=analysis.design,
        row_model=analysis.row_model,
        cohort=cohort,
        compared=cohort,
        classified=cohort,
    )
    return replace(extend("summarize", extend("score", fit(of_points))), skipped=())


def design(request: Request) -> Analysis:
    """Make the design, and the model of its rows."""
    _check_covariates(request)
    cohort, settings = request.cohort, request.settings
    matrix = build_design(
        request.table,
        request.model,
        settings.design,
        request.references,
        has_random=any(plan_blocks("rows", request)),
    )
    analysis = Analysis(
        request=request,
        design=matrix,
        row_model=RowModel(matrix, settings.glm),
        cohort=cohort,
        compared=cohort,
        classified=cohort,
    )
    matrix = extend("design", analysis).design
    if request.comparison.sessions.later or not matrix.contrasts:
        matrix = replace(matrix, contrasts=with_mean(matrix))
    rows = row_models(request)(matrix)
    _check_margins(rows.design, cohort, request.measures)
    inference.check_permutations(
        settings.multiplicity,
        settings.glm,
        rows.design.contrasts,
        further=find_permuting(settings),
    )
    analysis = replace(analysis, design=rows.design, row_model=rows)
    return extend("tests", analysis).noted(_parts_of_outcomes(request))


def align(analysis: Analysis) -> Analysis:
    """Register the sheets of each hemisphere, by their curvature."""
    request, cohort = analysis.request, analysis.cohort
    sides = {
        hemi: register_side(
            cohort,
            hemi,
            groups=request.groups,
            settings=request.settings,
            templates=request.templates,
        )
        for hemi in each("registration", list(cohort.sides) if request.measures.maps else [])
    }
    registered = {hemi: maps for hemi, (_, maps) in sides.items()}
    return replace(
        analysis,
        cohort=replace(cohort, sides=registered or cohort.sides),
        registrations={hemi: result for hemi, (result, _) in sides.items()},
        registered=registered,
    )


def fit(analysis: Analysis) -> Analysis:
    """Fit each hemisphere, and left minus right if asked for, and correct for many points."""
    request, analysis = analysis.request, extend("adjust", analysis)
    maps, comparison, rows = request.measures.maps, request.comparison, analysis.row_model
    compared = data.compare_sessions(analysis.cohort, comparison.sessions, request.model.added)
    fitted = {
        hemi: fit_maps(hemi, side.only(maps), rows)
        for hemi, side in each("models", list(compared.sides.items()) if maps else [])
    }
    if comparison.asymmetry and maps:
        # A change may be zero or of any sign: nothing to divide by.
        relative = () if comparison.sessions.later else request.settings.asymmetry.relative
        difference = data.asymmetry_maps(compared, maps, relative)
        contrasts = with_mean(rows.design)
        fitted[modeling.BOTH] = fit_maps(modeling.BOTH, difference, rows, contrasts=contrasts)
    analysis = replace(analysis, compared=compared, classified=compared, fitted=fitted)
    analysis = extend("tests", analysis)
    found = inference.correct(
        analysis.fitted,
        rows,
        compared.table,
        request.settings.multiplicity,
        report=partial(tell, "permutations"),
    )
    return replace(analysis, found=found)


def repeat_unregistered(analysis: Analysis) -> Analysis:
    """Fit the maps without registration, to show the effect of registration."""
    request = analysis.request
    is_slow = request.settings.multiplicity.method in inference.PERMUTATIONS
    if request.settings.registration.align == "none" or is_slow or not request.has_unregistered:
        return analysis
    before = fit(replace(analysis, cohort=request.cohort, registrations={}, registered={}))
    unregistered = {
        (key := inference.MapKey(measure, test.contrast.name, hemi)): (
            test.statistic,
            before.found[key],
        )
        for hemi, side in before.fitted.items()
        for measure, point_fit in side.fits.items()
        for test in point_fit.tests
    }
    return replace(analysis, unregistered=unregistered)


def score(analysis: Analysis) -> Analysis:
    """Leave the values of participants to extensions."""
    return extend("score", analysis)


def summarize(analysis: Analysis) -> Analysis:
    """Fit the model to summary measures, sizes also with intracranial volume."""
    request = analysis.request
    tell("summary measures")
    # A covariate that is a map has no value for a whole hemisphere.
    maps = request.model.maps
    measures, notes = fit_summaries(
        analysis.compared,
        request.model,
        analysis.row_model.design,
        request.settings.design,
        names=() if maps else request.measures.summaries,
        references=request.references,
        icv=request.icv,
        rows_of=row_models(request),
    )
    if maps:
        terms = listed(f"map({name})" for name in maps)
        notes.append(f"summary measures are not tested: {terms} has values at points only")
    return extend("summarize", replace(analysis, measures=measures).noted(notes))


def classify(analysis: Analysis) -> Analysis:
    """Compare classifiers of each pair of groups, by the first visits of participants."""
    groups, settings = analysis.groups, analysis.request.settings.classification
    if groups is None or not analysis.comparison.sessions.is_classified:
        return analysis
    is_first = ~analysis.request.table[PARTICIPANT].duplicated().to_numpy()
    cohort = extend("classify", analysis).classified.take(is_first)
    pairs, notes = classify_groups(cohort, groups, settings)
    return replace(analysis, pairs=pairs).noted(notes)


#: Steps after the design. Extensions add to them, see `hipsta_bids.joints.Step`.
LINE: tuple[Callable[[Analysis], Analysis], ...] = (
    align,
    fit,
    repeat_unregistered,
    score,
    summarize,
    classify,
)


def row_models(request: Request) -> Callable[[Design], RowModel]:
    """Choose the model of the rows."""
    sessions, settings = request.comparison.sessions, request.settings
    rows_of = sessions.row_models(request.table, request.time, request.groups, settings)
    return next(plan_blocks("rows", request), rows_of)


def _check_covariates(request: Request) -> None:
    """Refuse a map that explains itself."""
    maps, measures = request.model.maps, request.measures.maps
    if request.comparison.sessions.later:
        return
    if outcomes := [m for m in maps if m in measures]:
        raise ModelError(
            f"map({outcomes[0]}) in the formula explains itself; choose other maps by --measures"
        )


def _parts_of_outcomes(request: Request) -> list[str]:
    """Note covariates that contain what the maps measure."""
    return [
        f"{name} in the formula contains {measure}: effects are local, at equal {name}; for effects"
        f" on a hemisphere remove {name}"
        for name in request.model.summaries
        for measure in request.measures.maps
        if name.startswith((f"{measure}_", *CONTAINS.get(measure, ())))
    ]


def _check_margins(matrix: Design, cohort: data.Cohort, measures: data.Measures) -> None:
    """Refuse one margin for measures of several units."""
    names = [contrast.name for contrast in matrix.contrasts if contrast.margin]
    columns = {str(name) for side in cohort.sides.values() for name in side.summary.columns}
    summaries = columns if measures.summaries is None else columns & {*measures.summaries}
    units = {cohort.units[name] for name in (*measures.maps, *summaries) if name in cohort.units}
    if names and len(units) > 1:
        raise ModelError(
            f"contrast {names[0]!r}: a margin has one unit, but the measures have"
            f" {listed(sorted(units))}; choose one unit, as thickness + thickness_mean ~ group"
        )
