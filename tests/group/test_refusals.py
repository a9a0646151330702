"""Flags that exclude each other: one table, of the core and of extensions."""

from types import SimpleNamespace

import pytest
from extension_marks import needs

from hipsta_bids.errors import ModelError
from hipsta_bids.group.model import Sessions
from hipsta_bids.group.output import steps
from hipsta_bids.group.output.steps import EXCLUDED, plan_steps
from hipsta_bids.joints import find_steps


def request(*, sessions=None, maps=(), summaries=(), measured=("thickness",), method="fdr2"):
    """What the table is asked about; all else of a request does not matter to it."""
    settings = SimpleNamespace(multiplicity=SimpleNamespace(method=method))
    return SimpleNamespace(
        settings=settings,
        model=SimpleNamespace(maps=maps, summaries=summaries),
        measures=SimpleNamespace(maps=measured),
        comparison=SimpleNamespace(sessions=sessions or Sessions()),
    )


def core_flags():
    everything = request(maps=("x",), summaries=("y",), measured=(), method="permutation-max")
    return set(steps._flags(everything))


def test_every_name_in_the_table_is_a_flag():
    """A misspelled one would exclude nothing."""
    flags = core_flags() | {step.flag for step in find_steps()} | {"--endpoint"}
    table = {**EXCLUDED, **{step.flag: step.excludes for step in find_steps()}}
    assert set(table) <= flags
    assert {name for rivals in table.values() for name in rivals} <= flags


@pytest.mark.parametrize(
    "step", [step for step in find_steps() if step.excludes], ids=lambda step: step.name
)
def test_each_pair_of_a_step_is_refused(step, monkeypatch):
    monkeypatch.setattr(steps, "find_steps", lambda: (step,))
    monkeypatch.setattr(steps, "load", lambda _: lambda _: True)
    for name in step.excludes:
        monkeypatch.setattr(steps, "_flags", lambda _, name=name: iter([name]))
        with pytest.raises(ModelError, match="remove one of them") as error:
            plan_steps(request())
        assert str(error.value).startswith(f"{step.flag}: not with {name}")


def test_maps_in_the_formula_need_maps_to_explain(monkeypatch):
    monkeypatch.setattr(steps, "find_steps", tuple)
    with pytest.raises(ModelError, match="not with summary measures alone"):
        plan_steps(request(maps=("x",), measured=()))


@needs("repeated")
def test_visits_as_categories_are_not_permuted(monkeypatch):
    from hipsta_bids.extensions.repeated.sessions import Visits  # noqa: PLC0415  (may be deleted)

    monkeypatch.setattr(steps, "find_steps", tuple)
    with pytest.raises(ModelError, match="--longitudinal visits: not with"):
        plan_steps(request(sessions=Visits(), method="permutation-tfce"))
