"""Small reference cohorts for norms: sheets of several sites, skewed and heteroscedastic."""

from itertools import product

import numpy as np
from small_cohorts import NODES, SETTINGS, place_of, write_hemisphere, write_participants

from hipsta_bids.derivatives import dataset

SITES = {"A": (0.0, 1.0), "B": (0.15, 1.2), "C": (-0.1, 0.9), "D": (0.3, 1.4)}
"""Shift, mm, and scale."""
COLUMNS = ("participant_id", "group", "age", "sex", "site")


def wall(random, age, male, site, case=0):
    """Thickness of one person: thinner with age, spread wider, with a tail to thin walls."""
    shift, scale = SITES[site]
    own = 0.5 * random.standard_normal() + 0.87 * random.standard_normal(NODES)
    skewed = (1 - np.exp(0.35 * own) + 0.063) / 0.37
    sd = 0.08 * np.exp(0.5 * (age - 20) / 70)
    return 2.0 - 0.004 * (age - 20) + 0.05 * male + shift - 0.25 * case + scale * sd * skewed


def write_people(folder, counts, seed, *, cases=0, sessions=None):
    """A dataset of people by site; some more at the last site are cases."""
    data, out = folder / "bids", folder / "out"
    out.mkdir(parents=True)
    dataset.settle_settings(out, SETTINGS)
    dataset.write_description(out, {"fs": folder / "fs"})
    random = np.random.default_rng(seed)
    who = [(site, 0) for site, count in counts.items() for _ in range(count)]
    who += [(list(counts)[-1], 1)] * cases
    rows = []
    x = np.linspace(0, 1, NODES[0])[:, None] + np.zeros(NODES)
    for i, (site, case) in enumerate(who):
        age, male, subject = 20 + 65 * random.random(), i % 2, f"{seed}{i:03d}"
        visits = [None] if sessions is None else range(1, sessions + 1)
        for hemi, session in product("LR", visits):
            bend = 0.1 + 0.2 * np.exp(-(((x - 0.4 - 0.02 * random.standard_normal()) / 0.15) ** 2))
            bend = bend + 0.01 * random.standard_normal(NODES)
            thickness = wall(random, age, male, site, case)
            volume = 500 + 30 * male - age + 25 * random.standard_normal() - 60 * case
            place = place_of(out, subject, hemi, session=session and str(session))
            write_hemisphere(place, thickness, bend, volume=volume)
        rows.append([f"sub-{subject}", ("CN", "AD")[case], f"{age:.1f}", "FM"[male], site])
    write_participants(data, rows, COLUMNS)
    return data, out
