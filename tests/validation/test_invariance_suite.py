"""The suite of invariance: real labels in another form."""

from pathlib import Path

import pytest

from hipsta_bids.inputs.search import InputRequest, find_hemispheres
from validation import invariance
from validation.cases import Refusal

DATA = (Path(__file__).parents[2] / ".." / "shared" / "data" / "cobralab").resolve()


@pytest.mark.parametrize(
    ("results", "met"),
    [
        ([(0.01, 0.0), (0.02, 0.01)], [True, True]),
        ([(0.01, 0.0), (0.04, 0.01)], [False, True]),
        ([(0.01, 0.0), Refusal(reason="label-order", message="mirrored")], [False, False]),
    ],
)
def test_the_largest_change_is_judged(results, met):
    table = invariance._real_table(results)
    assert [row["met"] for row in table.rows] == met
    assert ("label-order: mirrored" in table.notes) == isinstance(results[-1], Refusal)


@pytest.mark.skipif(not DATA.is_dir(), reason="shared test data not found")
@pytest.mark.long
def test_real_labels_have_the_same_map_in_another_form(monkeypatch):
    request = InputRequest(bids_dir=DATA, participant_labels=("03",), hemis=("L",))
    (item, *_) = find_hemispheres(request)
    assert max(invariance.measure_forms(item)) < 1e-5
    # A mirror image that is measured as the same side is another map, or none.
    monkeypatch.setattr(invariance, "MIRROR", invariance.MIRROR * [[-1.0], [1.0], [1.0], [1.0]])
    with pytest.raises(Exception, match="labeled right"):
        invariance.measure_forms(item)
