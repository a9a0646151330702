"""Commands of agreement: their help, and the Python interface that has `correlate`."""

import pytest

import hipsta_bids as hb
from hipsta_bids.cli.parser import help_texts
from hipsta_bids.extensions.agreement.commands import (
    compare_parser,
    correlate_parser,
    replicate_parser,
)
from hipsta_bids.extensions.agreement.correlate import correlate


@pytest.mark.parametrize(
    ("command", "make"),
    [
        ("compare", compare_parser),
        ("replicate", replicate_parser),
        ("correlate", correlate_parser),
    ],
)
def test_the_texts_of_the_help_have_no_leftovers(command, make):
    actions = make()._actions
    names = {(action.option_strings or [action.dest])[0]: action.help for action in actions}
    texts = help_texts("hipsta_bids.extensions.agreement")[command]
    assert {name: names.get(name) for name in texts if name not in {"description", "epilog"}} == {
        name: text for name, text in texts.items() if name not in {"description", "epilog"}
    }


def test_the_python_interface_has_the_correlation():
    assert hb.correlate is correlate
