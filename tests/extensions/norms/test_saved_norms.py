"""Norms in files: the same scores, and refusals of damaged files."""

import json

import numpy as np
import pytest

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.norms.centiles import fit_norms
from hipsta_bids.extensions.norms.file import NormsFile, load_norms, save_norms
from hipsta_bids.extensions.norms.settings import NormSettings

KNOTS = np.array([20.0, 35, 50, 70, 90])


@pytest.fixture
def written(cohort, tmp_path):
    values, people = cohort
    norms = {("L", "thickness"): fit_norms(values, people, 2, KNOTS, NormSettings())}
    file = NormsFile(
        description="norms", format=1, hash="", version="1", versions=["1"], seg="demo",
        region="body", settings_hash="0", registration={}, template=None, x=[0.0], y=[0.0],
        age="age", sex="sex", site="site", knots=KNOTS.tolist(), sexes=["F", "M"],
        sites={"A": 70, "B": 50}, participants=120, norms={},
    )  # fmt: skip
    save_norms(tmp_path / "norms.json", file, norms)
    return tmp_path / "norms.json", norms


def test_files_give_the_same_scores(written, cohort):
    path, norms = written
    file, read = load_norms(path)
    assert file.sites == {"A": 70, "B": 50}
    key = "L", "thickness"
    np.testing.assert_allclose(read[key].score(*cohort), norms[key].score(*cohort), atol=1e-6)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda c: c.update(participants=7), "changed after it was written"),
        (lambda c: c.update(format=2), "format"),
        (lambda c: c.update(code="import os"), "code"),
        (lambda c: c.update(Hemispheres={}), r"norms \(it is a template of registration\)"),
        (lambda c: c["norms"]["L"]["thickness"]["shift"].pop(), "do not fit each other"),
        (lambda c: c["norms"]["L"]["thickness"]["mean"][0].pop(), "do not fit each other"),
        (
            lambda c: c["norms"]["L"]["thickness"]["scale"][0].__setitem__(0, -1.0),
            "has to be above 0",
        ),
        (lambda c: c.update(knots=[3.0, 2.0, 1.0]), "ascend"),
        (lambda c: c.update(seg="\x1b[31m"), "control characters"),
    ],
)
def test_damaged_files_are_refused_in_one_line(written, edit, said):
    path, _ = written
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ModelError, match=said) as error:
        load_norms(path)
    assert "\n" not in str(error.value)
