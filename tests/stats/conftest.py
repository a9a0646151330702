"""Reference values computed with R, where the shared data are present."""

import json
from pathlib import Path

import numpy as np
import pytest

ORACLE = Path(__file__).parents[2] / ".." / "shared" / "oracles" / "statistics.json"


@pytest.fixture(scope="session")
def oracle():
    if not ORACLE.is_file():
        pytest.skip("reference values of R not found")
    return json.loads(ORACLE.read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def r_data(oracle):
    """Data sets that come with R, as columns."""
    return {
        name: {column: np.array(values) for column, values in table.items()}
        for name, table in oracle["data"].items()
    }
