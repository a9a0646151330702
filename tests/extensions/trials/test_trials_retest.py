"""Agreement of repeated sessions: published examples, and what is missing."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from statsmodels.formula.api import ols
from statsmodels.stats.anova import anova_lm

from hipsta_bids.extensions.trials.sizes import repeatability

#: Six targets and four judges, table 2 of Shrout and Fleiss (1979).
JUDGED = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]
#: Peak expiratory flow by a large meter, l/min, twice (Bland and Altman 1986, table 1).
FLOW = [
    *([494, 490], [395, 397], [516, 512], [434, 401], [476, 470], [557, 611], [413, 415]),
    *([442, 431], [650, 638], [433, 429], [417, 420], [656, 633], [267, 275], [478, 492]),
    *([178, 165], [423, 372], [427, 421]),
]


def points(values):
    return np.array(values, dtype=np.float64)[:, :, None]


def test_agreement_is_that_of_shrout_and_fleiss():
    found = repeatability(points(JUDGED))
    # The paper prints two digits; limits are those of R's psych for its table.
    assert found["icc"][0] == pytest.approx(0.29, abs=0.005)
    assert [found["icc_low"][0], found["icc_high"][0]] == pytest.approx([0.019, 0.761], abs=0.0006)
    rows = [(i, j, v) for i, row in enumerate(JUDGED) for j, v in enumerate(row)]
    table = pd.DataFrame(rows, columns=["who", "when", "value"])
    squares = anova_lm(ols("value ~ C(who) + C(when)", table).fit())
    rows_ms, columns_ms, error_ms = squares["mean_sq"]
    expected = (rows_ms - error_ms) / (
        rows_ms + 3 * error_ms + 4 * (columns_ms - error_ms) / len(JUDGED)
    )
    assert found["icc"][0] == pytest.approx(expected, rel=1e-12)
    assert found["p_sessions"][0] == pytest.approx(squares["PR(>F)"].iloc[1], rel=1e-9)


def test_within_subject_sd_is_that_of_bland_and_altman():
    found = repeatability(points(FLOW))
    assert found["sd_within"][0] == pytest.approx(15.3, abs=0.05)
    assert found["detectable_change"][0] == pytest.approx(1.96 * np.sqrt(2) * found["sd_within"][0])
    assert found["sd_within"][0] ** 2 == pytest.approx(
        np.var(FLOW, axis=1, ddof=1).mean(), rel=1e-12
    )
    low, high = found["sd_within_low"][0], found["sd_within_high"][0]
    squares = 17 * found["sd_within"][0] ** 2
    assert stats.chi2.cdf(squares / low**2, 17) == pytest.approx(0.975)
    assert stats.chi2.cdf(squares / high**2, 17) == pytest.approx(0.025)


def test_limits_cover_the_true_agreement():
    """ICC .6 with a session effect; 2,000 studies of 30 participants in three sessions."""
    random = np.random.default_rng(0)
    people, n = 2000, 30
    values = np.sqrt(0.6) * random.standard_normal((n, 1, people))
    values = values + np.sqrt(0.05) * random.standard_normal((1, 3, people))
    values = values + np.sqrt(0.35) * random.standard_normal((n, 3, people))
    found = repeatability(values)
    low, high = found["icc_low"], found["icc_high"]
    covered = ((low < 0.6) & (high > 0.6)).mean()
    # Three standard errors of 2,000 studies are .015.
    assert covered == pytest.approx(0.95, abs=0.02)
    assert np.mean(found["sd_within"] ** 2) == pytest.approx(0.4, abs=0.01)
    assert np.mean(found["sd_between"] ** 2) == pytest.approx(0.6, abs=0.02)


def test_missing_values_cost_a_participant_at_their_points_only():
    values = np.repeat(points(FLOW), 3, axis=2)
    values[4, 1, 1] = np.nan
    values[3:, 0, 2] = np.nan
    found = repeatability(values, least=5)
    assert found["n"].tolist() == [17, 16, 3]
    without = repeatability(points([row for i, row in enumerate(FLOW) if i != 4]))
    assert found["icc"][1] == pytest.approx(without["icc"][0], rel=1e-12)
    assert found["sd_within"][0] == pytest.approx(
        repeatability(points(FLOW))["sd_within"][0], rel=1e-12
    )
    assert np.isnan([found["icc"][2], found["sd_within"][2], found["p_sessions"][2]]).all()


def test_values_that_do_not_vary_have_no_agreement():
    found = repeatability(np.ones((6, 2, 1)))
    assert np.isnan(
        [found["icc"][0], found["sd_within"][0], found["icc_low"][0], found["icc_high"][0]]
    ).all()
