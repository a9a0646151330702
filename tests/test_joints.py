"""What extensions declare: each function that they name exists."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass

import pytest

from hipsta_bids.joints import find_extensions, load


def places(value):
    """Find ``module:name`` in a declaration, at any depth."""
    if is_dataclass(value):
        for one in fields(value):
            yield from places(getattr(value, one.name))
    elif isinstance(value, Mapping):
        for entry in value.values():
            yield from places(entry)
    elif isinstance(value, tuple):
        for entry in value:
            yield from places(entry)
    elif isinstance(value, str) and value.startswith("hipsta_bids.") and ":" in value:
        yield value


@pytest.mark.parametrize("extension", find_extensions(), ids=lambda one: one.package)
def test_every_function_of_an_extension_exists(extension):
    declared = list(places(extension))
    assert declared
    for place in declared:
        assert load(place) is not None
    assert extension.meaning.endswith(".")
