"""Steps that extensions add to the line of an analysis, and what they add to its results."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from hipsta_bids.errors import ModelError
from hipsta_bids.group.cohort.data import SHEET
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.request import Request
from hipsta_bids.joints import Step, find_steps, load
from hipsta_bids.stats.formula import listed
from hipsta_bids.stats.inference import PERMUTATIONS

#: Flags of covariates of each hemisphere.
COVARIATES = ("map() in the formula", "summary measures in the formula")
#: Flags of the core, and those that they exclude; extensions have their own.
EXCLUDED: Mapping[str, Sequence[str]] = {COVARIATES[0]: ("summary measures alone",)}


def plan_steps(request: Request) -> Request:
    """Plan the steps that are asked; ModelError if two of them exclude each other."""
    steps = [step for step in find_steps() if load(step.condition)(request)]
    flags = {*_flags(request), *(step.flag for step in steps)}
    excluded = {**EXCLUDED, **request.comparison.sessions.excludes()}
    for flag, rivals in (excluded | {step.flag: step.excludes for step in steps}).items():
        if flag in flags and (problems := [name for name in rivals if name in flags]):
            raise ModelError(f"{flag}: not with {listed(problems)}; remove one of them")
    plans = {step.name: load(step.plan)(request) for step in steps}
    return replace(request, plans=plans)


def _flags(request: Request) -> Iterator[str]:
    """Name what the core is asked beyond the default."""
    settings = request.settings
    is_asked = {
        COVARIATES[0]: bool(request.model.maps),
        COVARIATES[1]: bool(request.model.summaries),
        "summary measures alone": not request.measures.maps,
        "--correction by permutation": settings.multiplicity.method in PERMUTATIONS,
    }
    yield from (flag for flag, answer in is_asked.items() if answer)
    yield from request.comparison.sessions.excludes()


def _active(request: Request) -> Iterator[Step]:
    return (step for step in find_steps() if step.name in request.plans)


def extend(place: str, analysis: Analysis) -> Analysis:
    """Pass an analysis through what extensions do at a place of the line."""
    for step in _active(analysis.request):
        if place in step.places:
            analysis = load(step.places[place])(analysis, analysis.request.plans[step.name])
    return analysis


def extend_surfaces(analyses: Mapping[str, Analysis]) -> Mapping[str, Analysis]:
    """Pass the analyses of all surfaces, by name, through what extensions do with all of them."""
    plans = analyses[SHEET].request.plans
    for step in _active(analyses[SHEET].request):
        if "surfaces" in step.places:
            analyses = load(step.places["surfaces"])(analyses, plans[step.name])
    return analyses


def blocks(place: str, request: Request, *values: object) -> Iterator[Any]:
    """Collect what extensions make of results at a place: tables, paragraphs, figures, files."""
    for step in _active(request):
        if place in step.blocks:
            yield from load(step.blocks[place])(*values)


def plan_blocks(place: str, request: Request) -> Iterator[Any]:
    """Collect what extensions know from their plans."""
    for step in _active(request):
        if place in step.blocks:
            yield from load(step.blocks[place])(request.plans[step.name])
