"""Phantoms that are solved once and looked at by many tests."""

import pytest
from geometry_cases import short_phantom, solve_case


@pytest.fixture(scope="session")
def arc():
    """Radius 5 mm, thickness 2 mm, left."""
    return solve_case(short_phantom())


@pytest.fixture(scope="session")
def slab():
    """Flat, thickness 2 mm, left."""
    return solve_case(short_phantom(kind="slab", curvature=None))


@pytest.fixture(scope="session")
def spiral():
    """Tightening bend, thickness 2 mm, right."""
    return solve_case(short_phantom(kind="spiral", curvature=None, width=20.0), hemi="R")


@pytest.fixture(scope="session", params=["arc", "slab", "spiral"])
def case(request):
    """Each of the three in turn."""
    return request.getfixturevalue(request.param)
