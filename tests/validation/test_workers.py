"""Cases in workers that refuse, fail, die or hang."""

import pytest
from validation_jobs import work

from hipsta_bids.participant.pool import processors
from validation.cases import Refusal, run_cases

pytestmark = pytest.mark.usefixtures("workers")


def test_results_come_in_the_order_of_the_cases():
    cases = [5, "refuse", 7, "bug", "die", 1]
    five, refused, seven, bug, died, one = run_cases(work, cases)
    assert (five, seven, one) == (10, 14, 2)
    assert refused == Refusal(reason="sheet-too-thin", message="too thin; use smaller voxels")
    assert not refused.is_bug
    assert bug == Refusal(reason="crash", message="ZeroDivisionError: one by zero")
    assert (died.reason, died.message) == ("worker-died", "the worker died (SIGABRT)")
    assert bug.is_bug
    assert died.is_bug


def test_a_case_that_hangs_is_given_up():
    (result,) = run_cases(work, ["hang"], timeout=0.5)
    assert result.reason == "timeout"
    assert result.is_bug


def test_no_cases_need_no_workers():
    assert run_cases(work, []) == []


def test_there_is_at_least_one_processor():
    assert processors() >= 1
