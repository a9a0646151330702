"""Which participants of repeated sessions are in an analysis of agreement."""

import numpy as np
import pandas as pd
import pytest

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.trials.trial import Retested
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.settings import GroupSettings


def cohort(*visits):
    table = pd.DataFrame(
        [visit.split() for visit in visits],
        columns=["participant_id", "session_id"],
        index=list(visits),
    )
    return Cohort(table=table, sides={}, x=np.zeros(1), y=np.zeros(1), units={})


#: The fewest participants that the settings permit.
LEAST = GroupSettings().changed(retest={"min_participants": 3})


def test_participants_who_lack_a_session_are_left_out():
    own = Retested(cohort("b 1", "b 2", "a 2", "a 1", "c 1", "d 1", "d 2"), LEAST)
    assert own.participants == ["a", "b", "d"]
    assert own.complete.tolist() == [True, True, True, True, False, True, True]
    # In the order of participants and sessions, whatever that of the visits.
    values = np.array([[1.0], [2.0], [20.0], [10.0]])
    assert own.arrange(values, np.arange(4))[:2, :, 0].tolist() == [[10, 20], [1, 2]]
    alone = own.arrange(values[:1], np.array([3]))[:, :, 0]
    assert (alone[0, 0], np.isnan(alone).sum()) == (1, 5)


def test_too_few_with_all_sessions_are_refused():
    with pytest.raises(ModelError, match=r"1 \(2\), 2 \(1\).*--session-label"):
        Retested(cohort("a 1", "a 2", "b 1"), LEAST)
    with pytest.raises(ModelError, match="no second session"):
        Retested(cohort("a 1", "b 1"), LEAST)
