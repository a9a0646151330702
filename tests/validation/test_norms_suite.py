"""The suite of norms: what is planted, and that all of its rows are judged."""

import numpy as np

from validation import norms


def test_people_are_what_is_said_of_them():
    random = np.random.default_rng(0)
    for population in norms.POPULATIONS:
        drawn = population.draw(random, (200_000,))
        np.testing.assert_allclose([drawn.mean(), drawn.std()], [0, 1], atol=0.015)
    values, people = norms.simulate(norms.POPULATIONS[1], (4000, 4000), 1, 0)
    again, _ = norms.simulate(norms.POPULATIONS[1], (4000, 4000), 1, 1)
    site = people.site == 1
    shifts = [one[site].mean() - one[~site].mean() for one in (values, again)]
    assert abs(shifts[0]) > 0.02
    np.testing.assert_allclose(shifts[0], shifts[1], atol=0.02)
    old = people.age > 70
    assert values[old].std() > 1.2 * values[people.age < 40].std()


def test_all_populations_are_judged_at_known_and_new_sites(monkeypatch):
    monkeypatch.setattr(norms, "_FEW_POINTS", 16)
    monkeypatch.setattr(norms, "_PEOPLE", 1000)
    (table,) = norms.run(full=False).tables
    assert table.targets == 2 * len(norms.POPULATIONS)
    known = [row["met"] for row in table.rows if row["scored"] == "known sites"]
    assert all(known)
