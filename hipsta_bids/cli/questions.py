"""Questions of the group level other than comparisons: their options, and which go together."""

import argparse
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from hipsta_bids.cli.parser import Parser, adder, factor_level
from hipsta_bids.errors import UsageError
from hipsta_bids.joints import Question, find_parts, find_questions, load

if TYPE_CHECKING:
    from hipsta_bids.group.questions.study import GroupOptions, GroupResult
    from hipsta_bids.group.settings import GroupSettings

#: Options that only comparisons have.
_COMPARISON_ONLY = (
    *("longitudinal", "endpoint", "paired", "asymmetry", "normative", "model", "contrast"),
    *("permutations", "blocks", "fdr_scope", "base", "no_classification"),
    *("joint", "joint_sides"),
    *("harmonize", "harmonize_model"),
)


#: Norms, which the core asks.
_NORMS = Question(
    flags=("fit_norms", "norms"),
    dependents=("controls", "among"),
    without="--norms",
    options=f"{__name__}:add_norms",
    run=f"{__name__}:run_norms",
)


def all_questions() -> tuple[Question, ...]:
    """List the questions of the extensions and of the core."""
    return (*find_questions(), _NORMS)


def listed_questions() -> str:
    """List the options that ask questions, for the help."""
    flags = [_flag(name) for question in all_questions() for name in question.flags]
    return f"{', '.join(flags[:-1])} and {flags[-1]}"


def add_questions(parser: Parser) -> None:
    """Add all options of these questions."""
    for question in all_questions():
        load(question.options)(parser)
    adder(parser.add_argument_group("for trials and norms"))(
        "--among",
        "COLUMN=LEVEL",
        "only participants like this, as group=AD",
        type=factor_level,
    )


def add_norms(parser: Parser) -> None:
    """Add the options of norms."""
    add = adder(parser.add_argument_group("norms (instead of a comparison)"))
    add(
        "--fit-norms",
        "",
        "norms of these participants: mean and SD by age, sex and site, per point and "
        "summary measure, without participants' values",
    )
    add(
        "--norms",
        "FILE",
        "score these participants by the norms.json of --fit-norms: deviations and centiles",
    )
    add(
        "--controls",
        "COLUMN=LEVEL",
        "controls that estimate shift and scale of new sites, as group=CN; at least 25 per site",
        type=factor_level,
    )


def is_question(parsed: argparse.Namespace) -> bool:
    """Check whether something other than a comparison is asked."""
    return any(getattr(parsed, name) for question in all_questions() for name in question.flags)


def run_comparison(
    parsed: argparse.Namespace, options: "GroupOptions", settings: "GroupSettings"
) -> "GroupResult":
    """Compare participants."""
    from hipsta_bids.group.questions.compare import run_group  # noqa: PLC0415  (heavy)

    for question in all_questions():
        refuse(parsed, question.dependents, f"without {question.without}")
    multiplicity = settings.multiplicity
    if not settings.joint.measures and not multiplicity.method.startswith("permutation"):
        refuse(
            parsed, ("permutations", "blocks"), "without permutations, by --correction or --joint"
        )
    elif multiplicity.permutations * multiplicity.alpha < 1:
        raise UsageError(
            f"{multiplicity.permutations} permutations cannot give p of"
            f" {multiplicity.alpha:g}; at least {math.ceil(1 / multiplicity.alpha)}"
            " are needed, and thousands are better"
        )
    if protocols := tuple(dict.fromkeys(parsed.seg))[1:]:
        from hipsta_bids.group.questions.several import run_protocols  # noqa: PLC0415  (heavy)

        return run_protocols(options, settings, (parsed.seg[0], *protocols))
    return run_group(options, settings)


def run_question(
    parsed: argparse.Namespace, options: "GroupOptions", settings: "GroupSettings"
) -> "GroupResult":
    """Answer the question that options ask."""
    questions = [q for q in all_questions() if any(getattr(parsed, name) for name in q.flags)]
    flags = [_flag(name) for q in questions for name in q.flags if getattr(parsed, name)]
    if len(questions) > 1:
        raise UsageError(f"give one of {', '.join(flags)}")
    parts = [part.name for part in find_parts()]
    refuse(parsed, (*_COMPARISON_ONLY, *parts), f"with {' and '.join(flags)}")
    if len(set(parsed.seg)) > 1:
        raise UsageError(f"--seg: name one protocol with {' and '.join(flags)}")
    if settings.harmonization.column:
        raise UsageError(
            f"{' and '.join(flags)}: harmonization is not possible; remove "
            "harmonization.column from the settings"
        )
    result: GroupResult = load(questions[0].run)(parsed, options, settings)
    return result


def run_norms(
    parsed: argparse.Namespace, options: "GroupOptions", settings: "GroupSettings"
) -> "GroupResult":
    """Fit norms, or score participants by them."""
    from hipsta_bids.group.questions import norming  # noqa: PLC0415  (heavy)

    if parsed.fit_norms and parsed.norms:
        raise UsageError("give one of --fit-norms, --norms")
    flag = "--fit-norms" if parsed.fit_norms else "--norms"
    for question in find_questions():
        names = [name for name in question.dependents if name not in _NORMS.dependents]
        refuse(parsed, names, f"without {question.without}")
    refuse(parsed, ("formula", "age_model"), f"with {flag}")
    if parsed.norms is None:
        refuse(parsed, ("controls",), "without --norms")
    else:
        refuse(parsed, ("align", "template"), "with --norms, whose registration is taken")
    among, controls = parsed.among, parsed.controls
    return norming.run_norms(options, settings, path=parsed.norms, among=among, controls=controls)


def refuse(parsed: argparse.Namespace, names: Sequence[str], context: str) -> None:
    """Refuse options that would have no effect; ``names`` are of Python."""
    flags = [_flag(name) for name in names if getattr(parsed, name)]
    if flags:
        raise UsageError(f"{', '.join(flags)}: has no effect {context}; remove the option")


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
