"""What a summary for other sites must not hold: numbers about one to four participants."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from check_disclosure import attack_designs, share_of_ordinary

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.consortia import exchange
from hipsta_bids.stats.design import build_design
from hipsta_bids.stats.disclosure import check_cells, check_people, is_traceable
from hipsta_bids.stats.formula import ModelSpec, typed
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.stats.settings import DesignSettings, ExchangeSettings


def people(n_cell, seed=0, cells=(("CN", "F"), ("CN", "M"), ("AD", "F"), ("AD", "M"))):
    """Participants of each cell of groups and sexes; ages with two digits, as no two are equal."""
    random = np.random.default_rng(seed)
    n = n_cell * len(cells)
    table = pd.DataFrame([cell for cell in cells for _ in range(n_cell)], columns=["group", "sex"])
    return table.assign(
        age=np.round(random.uniform(55, 85, n), 2), icv=np.round(random.normal(1500, 150, n), 1)
    )


def check(table, formula, **limits):
    design = build_design(table, ModelSpec("m", formula, (), None), DesignSettings(), {})
    names = closed_formula(formula).names
    variables = {name: typed(table[name]) for name in names}
    return check_people([design], variables, ExchangeSettings(**limits))


@pytest.mark.parametrize(
    "formula", ["group + age + sex", "group*age + sex", "group*sex + age", "group*sex + age + icv"]
)
def test_cells_of_five_are_enough_and_of_four_too_few(formula):
    table = people(5)
    assert [len(rows) for rows in check(table, formula)] == [5] * 4
    said = "sex=M in group=AD holds fewer than 5 participants; merge levels, or remove sex"
    with pytest.raises(ModelError, match=said):
        check(table.iloc[:-1], formula)


def test_a_cell_of_three_factors_is_named_though_no_interaction_has_it():
    table = people(20)
    table["site"] = np.where(np.arange(80) % 20 < 10, "a", "b")
    check(table, "group + sex + site")
    rare = (table.group == "AD") & (table.sex == "M") & (table.site == "b")
    table.loc[rare[rare].index[:6], "site"] = "a"
    with pytest.raises(ModelError, match="site=b in group=AD, sex=M holds fewer than 5"):
        check(table, "group + sex + site")


def test_an_empty_cell_says_that_nobody_is_in_it_and_is_refused():
    table = people(12, cells=(("CN", "F"), ("CN", "M"), ("AD", "F")))
    with pytest.raises(ModelError, match="sex=M in group=AD holds fewer than 5"):
        check(table, "group + age + sex")
    check(table, "group + age")


def test_values_of_a_number_with_few_values_are_levels():
    """From the sums of 1, x and x squared follow the counts of three values."""
    table = people(25)
    table["apoe"] = np.resize([0, 0, 1, 1, 2], 100)
    check(table, "group + apoe")
    table["apoe"] = table["apoe"].mask(table["apoe"].eq(2) & (np.arange(100) > 22), 0)
    with pytest.raises(ModelError, match="apoe=2 holds fewer than 5 participants; merge levels"):
        check(table, "group + apoe")


@pytest.mark.parametrize("bend", ["abs(age - {})", "sqrt((age - {})**2)"])
def test_a_bend_beyond_which_few_participants_are_is_refused(bend):
    """The function and the line together are zero but for the participants beyond."""
    table = people(25)
    oldest = np.sort(table["age"])
    check(table, f"age + {bend.format(70)}")
    with pytest.raises(ModelError, match=r"sums of .* are about fewer than 5 participants"):
        check(table, f"age + {bend.format(round(oldest[-5:-3].mean(), 3))}", max_leverage=0.99)
    # Eight are older, but some group has fewer of them.
    knot = round(float(oldest[-9:-7].mean()), 3)
    check(table, f"age + {bend.format(knot)}")
    with pytest.raises(ModelError, match=r"sums of .* are about fewer than 5 participants"):
        check(table, f"group + age + {bend.format(knot)}")


def test_a_number_in_which_few_of_a_group_differ_is_refused():
    table = people(25)
    table["score"] = np.where(table.group == "CN", 30.0, 20 + np.arange(100) % 9)
    with pytest.raises(ModelError, match="fewer than 5 participants in group=CN differ in score"):
        check(table, "group + score")
    table.loc[[0, 1, 2], "score"] = 29.0
    with pytest.raises(ModelError, match="fewer than 5 participants in group=CN differ in score"):
        check(table, "group + score")
    table.loc[range(12), "score"] = np.arange(12) + 18.0
    check(table, "group + score")


def test_a_column_that_is_nonzero_for_few_is_found_in_random_models():
    """A combination of columns that hides it changes nothing."""
    random = np.random.default_rng(1)
    for _ in range(20):
        n = int(random.integers(40, 120))
        some = random.choice(n, int(random.choice([2, 3, 4, 12])), replace=False)
        table = pd.DataFrame(random.normal(size=(n, 3)), columns=list("abc"))
        hidden = np.zeros(n)
        hidden[some] = random.uniform(1, 2, len(some))
        table["d"] = hidden + table["a"] - 2 * table["b"]
        if len(some) < 5:
            with pytest.raises(ModelError, match=r"sums of|determines"):
                check(table, "a + b + c + d")
        else:
            check(table, "a + b + c + d")


def test_more_sums_than_participants_are_refused():
    random = np.random.default_rng(2)
    names = [f"x{i}" for i in range(8)]
    table = pd.DataFrame(random.normal(size=(60, 8)), columns=names)
    check(table, " + ".join(names))
    with pytest.raises(ModelError, match="46 participants are too few for 9 columns"):
        check(table[:46], " + ".join(names))
    with pytest.raises(ModelError, match="11 participants are too few for 2 columns"):
        check(table[:11], "x0")


def test_groups_that_are_not_in_the_model_are_counted_too():
    groups = pd.Series(["CN"] * 20 + ["AD"] * 4)
    with pytest.raises(ModelError, match="group=AD holds fewer than 5"):
        check_cells({"group": groups}, 5)
    with pytest.raises(ModelError, match="group=n/a holds fewer than 5"):
        check_cells({"group": pd.Series(["CN"] * 20 + ["AD"] * 9 + [None])}, 5)


def test_measures_that_count_rare_findings_are_traceable():
    random = np.random.default_rng(0)
    values = random.normal(size=(40, 4))
    values[:, 1] = 0
    values[7, 1] = 2.5
    values[:, 2] = np.arange(40) % 4
    values[:20, 3] = 1.0
    cells = [np.arange(20), np.arange(20, 40)]
    assert is_traceable(values, cells, 5).tolist() == [False, True, True, True]
    values[:5, 3] = np.arange(5) + 2
    assert not is_traceable(values, cells, 5)[3]


def test_nothing_is_read_out_of_summaries_of_random_designs():
    """`tools/test-disclosure` attacks 1,000."""
    outcome = attack_designs(60)
    assert outcome.exported > 15
    assert outcome.kinds == {}
    assert outcome.leaking == 0


def test_the_attack_reads_most_summaries_without_the_rule(monkeypatch):
    monkeypatch.setattr(exchange, "check_people", lambda *_: [])
    monkeypatch.setattr(
        exchange, "is_traceable", lambda values, *_: np.zeros(values.shape[1], bool)
    )
    outcome = attack_designs(15)
    assert outcome.exported == 15
    assert outcome.leaking > 10
    assert {"cell", "sum"} < set(outcome.kinds)


def test_ordinary_cohorts_are_exported():
    assert share_of_ordinary(12) == 1
    assert share_of_ordinary(12, n=60) > 0.9


def test_points_of_other_participants_would_disclose_a_participant():
    """Attack: standard errors at a point without some participants, and at another point."""
    table = people(15)
    table["old"] = (table.group == "AD").astype(float)
    columns = np.column_stack([np.ones(60), table.old, table.age])
    for omitted, further in (([], [7]), ([1, 12, 20, 33, 50], [1, 7, 12, 20, 33, 50])):
        sums = []
        for rows in (np.delete(np.arange(60), gone) for gone in (omitted, further)):
            spread = np.linalg.inv(columns[rows].T @ columns[rows])
            # se / sd of contrasts of columns and of pairs of them are published.
            pairs = [np.eye(3)[i] + np.eye(3)[j] for i in range(3) for j in range(3)]
            ratio = np.array([w @ spread @ w for w in pairs]).reshape(3, 3)
            single = np.diag(ratio) / 4
            published = (ratio - single[:, None] - single) / 2
            sums.append(np.linalg.inv(published))
        participant = sums[0] - sums[1]
        # Sums of squares of ages are 3e5: 1e-8 of them is the error of the two inversions.
        assert participant[0, 0] == pytest.approx(1, abs=1e-3)
        assert participant[0, 2] == pytest.approx(table.age[7], abs=0.01)
        assert participant[0, 1] == pytest.approx(table.old[7], abs=1e-3)


def missing_maps(missing):
    """An analysis of one map, as far as the choice of participants reads it."""
    values = np.where(missing, np.nan, 1.0)
    maps = SimpleNamespace(rows=np.arange(len(values)), maps={"thickness": values})
    return SimpleNamespace(fitted={"L": SimpleNamespace(maps=maps, fits={"thickness": None})})


def test_participants_with_many_missing_points_are_omitted_only_five_or_more():
    random, rows = np.random.default_rng(0), np.arange(55)
    missing = np.zeros((55, 861), dtype=bool)
    assert len(exchange._most_complete(missing_maps(missing), rows, 5)) == 55
    missing[3] = True  # one alone is never omitted; with four others, no point is lost
    kept = exchange._most_complete(missing_maps(missing), rows, 5)
    assert len(kept) == 50
    assert 3 not in kept
    missing[3], missing[:5] = False, random.random((5, 861)) < 0.33
    kept = exchange._most_complete(missing_maps(missing), rows, 5)
    np.testing.assert_array_equal(kept, rows[5:])
    missing = random.random((55, 861)) < 0.03  # at random: a tenth at most
    kept = exchange._most_complete(missing_maps(missing), rows, 5)
    assert len(kept) == 50
    complete = (~missing[kept].any(axis=0)).sum()
    assert complete > 1.15 * (~missing.any(axis=0)).sum()  # 0.97^-5 is 1.16, greedy gives more
    few = missing[:, :40] & (rows[:, None] == 9)  # a gap at few points: all participants stay
    few[9, 0] = True
    assert len(exchange._most_complete(missing_maps(few), rows, 5)) == 55
