"""The code of docs/python.md runs as it stands."""

import matplotlib as mpl
import pytest
from matplotlib import pyplot as plt
from measured_phantoms import measured, spiral
from python_figures import blocks

from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.hemisphere import ResultPlace, write_results
from hipsta_bids.derivatives.names import HemisphereName
from hipsta_bids.settings import Settings


@pytest.fixture
def demo(tmp_path, monkeypatch):
    """Two participants where the page looks for them, and no screen."""
    root = tmp_path / "demo" / "out"
    root.mkdir(parents=True)
    dataset.settle_settings(root, Settings())
    for hemi in "LR":
        case = measured(spiral(), hemi=hemi, voxel=0.5)
        for subject in ("01", "02"):
            name = HemisphereName(subject=subject, session=None, hemi=hemi, seg="freesurfer")
            place = ResultPlace(root=root, name=name)
            write_results(place, case.maps, case.volume.protocol, {}, write_meshes=False)
    monkeypatch.chdir(tmp_path)
    with mpl.rc_context({"backend": "agg"}):
        yield
    plt.close("all")


@pytest.mark.usefixtures("demo")
def test_code_of_the_page_runs():
    names = {}
    for code in blocks():
        exec(code, names)  # noqa: S102  (our own page)
    assert names["left"].decision == "use"
    assert names["measures"]["participant_id"].nunique() == 2
    assert names["fit"].significant[0, 0, 12:22, :10].mean() > 0.5
    assert len(plt.get_fignums()) == 3
