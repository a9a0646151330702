"""The time of visits: given, from dates, or from ages."""

import pandas as pd
import pytest

from hipsta_bids.errors import ModelError
from hipsta_bids.group.cohort.covariates import add_time
from hipsta_bids.group.settings import GroupSettings

SETTINGS = GroupSettings()
WHO = ["sub-1", "sub-1", "sub-2", "sub-2"]


def visits(**columns):
    return pd.DataFrame({"participant_id": WHO, **columns}, index=list("abcd"), dtype=object)


def test_a_column_that_varies_between_sessions_is_the_time():
    table = visits(time=["5", "5", "6", "6"], Months=["0", "12", "0", "n/a"])
    found = add_time(table, SETTINGS)
    assert found.column == "Months"  # time is the same at all sessions of each
    assert found.table.Months[:3].tolist() == [0, 12, 0]
    assert pd.isna(found.table.Months.iloc[3])
    assert found.covariates == SETTINGS.model.covariates


def test_dates_become_years_since_the_first_session():
    dates = ["1887-02-03T10:00:00", "1889-02-03", "1888-01-01T00:00:00", "1887-01-01T00:00:00"]
    found = add_time(visits(acq_time=dates), SETTINGS)
    assert found.column == "time"
    # Days are counted from the first hour; a year has 365.25 of them.
    assert found.table.time.tolist() == pytest.approx([0, 2.0, 1.0, 0], abs=0.004)
    with pytest.raises(ModelError, match="is not a date"):
        add_time(visits(acq_time=["1887-02-03", "later", None, None]), SETTINGS)


def test_age_at_visits_gives_time_and_leaves_the_first_age_as_covariate():
    found = add_time(visits(Age=["61.5", "63", "70", "70.5"]), SETTINGS)
    assert found.column == "time"
    assert found.table.time.tolist() == [0, 1.5, 0, 0.5]
    assert found.table.age_first.tolist() == [61.5, 61.5, 70, 70]
    assert found.covariates == ("age_first", "sex", "site")


def test_nothing_tells_the_time():
    found = add_time(visits(age=["61", "61", "70", "70"]), SETTINGS)
    assert found.column is None
    assert found.covariates == SETTINGS.model.covariates
