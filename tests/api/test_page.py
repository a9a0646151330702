"""The code of docs/python.md runs as it stands."""

import matplotlib as mpl
import pytest
from matplotlib import pyplot as plt
from python_figures import blocks

import hipsta_bids as hb


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder, and no screen."""
    monkeypatch.chdir(tmp_path)
    with mpl.rc_context({"backend": "agg"}):
        yield tmp_path
    plt.close("all")


def test_code_of_the_page_runs(folder):
    names = {}
    for code in blocks():
        exec(code, names)  # noqa: S102  (our own page)
    assert names["left"].decision == "use"
    assert names["measures"]["participant_id"].nunique() == 10
    # Thinner in the anterior CA1, by .3 mm.
    anterior = names["left"].subfield[:, -8:] == "CA1"
    estimate = names["fit"].maps["estimate"][0, 0]
    assert 0.15 < estimate[:, -8:][anterior].mean() < 0.45
    assert names["fit"].significant[0, 0, :, -8:][anterior].mean() > 0.2
    assert len(plt.get_fignums()) == 3
    assert hb.load(folder / "measured").measures["decision"].tolist() == ["use"]
    assert len(list((folder / "statistics").glob("*.gii"))) == 3
    assert len(list((folder / "surfaces").glob("*.gii"))) == 16
