"""Outliers of drawn cohorts, with a damaged hemisphere or an effect in a third of them."""

import json

import numpy as np
import pytest
from scipy import ndimage

from hipsta_bids.derivatives import dataset, outliers
from hipsta_bids.derivatives.measures import read_compared, write_measures
from hipsta_bids.derivatives.names import HemisphereName
from hipsta_bids.derivatives.results import ResultPlace
from hipsta_bids.io import files

NODES, STEP = (41, 21), np.array([0.6, 1.25])
#: Standard deviations, mm, of the kernel of a field whose values correlate over 3 to 5 mm.
KERNEL = (2.1, 3.5)
#: Seeds of the cohorts on which limits are judged; they were chosen on others (300 to 330).
SEED = 900


def draw_field(rng, sd, kernel):
    """Draw a smooth random field of one standard deviation, kernel in mm."""
    pad = 20
    sigma = kernel / STEP
    noise = rng.standard_normal((NODES[0] + 2 * pad, NODES[1] + 2 * pad))
    field = ndimage.gaussian_filter(noise, sigma)[pad:-pad, pad:-pad]
    return sd * field * np.sqrt(4 * np.pi * np.prod(np.maximum(sigma, 0.29)))


def draw_cohort(seed, count=30, effect=None):
    """Draw maps, which vary in level, place and locally, and who has an effect."""
    rng = np.random.default_rng(seed)
    x, y = np.indices(NODES)
    u, v = x / 40, y / 20
    mean = 1.8 + 0.35 * np.sin(8.2 * u + 0.4) + 0.15 * np.cos(9.4 * u) * np.cos(3.1 * v)
    sd, kernel, maps = rng.uniform(0.15, 0.2), rng.uniform(*KERNEL), []
    for _ in range(count):
        at = [x + rng.normal(0, 0.7) + draw_field(rng, 1, 6), y + rng.normal(0, 1)]
        values = ndimage.map_coordinates(mean, at, order=1, mode="nearest")
        values = values * rng.normal(1, 0.06) + rng.normal(0, 0.05)
        maps.append(values + draw_field(rng, sd, kernel) + draw_field(rng, 0.05, 0.42))
    affected = np.zeros(count, dtype=bool)
    if effect:
        affected[rng.permutation(count)[: count // 3]] = True
    for n in np.flatnonzero(affected):
        left, right, start = np.array([0.3, 0.65, 0.5]) + rng.normal(0, 0.02, 3)
        inside = {"all": u >= 0, "CA1": (u > left) & (u < right)}
        inside["CA1-anterior"] = inside["CA1"] & (v > start)
        weight = ndimage.gaussian_filter(inside[effect].astype(float), (1, 0.6))
        maps[n] *= 1 - 0.2 * rng.uniform(0.7, 1.3) * weight
    return np.array(maps), affected


def draw_damage(rng):
    """Draw the change by a voxel too many or too few: 40 to 48 nodes are off by .3 to .7 mm."""
    while True:
        change, width, length = np.zeros(NODES), rng.integers(7, 14), rng.integers(4, 8)
        i, j = rng.integers(1, 40 - width), rng.integers(0, 21 - length)
        change[i : i + width, j : j + length] = rng.uniform(0.38, 0.72) * rng.choice((-1, 1))
        change = ndimage.gaussian_filter(change, (1, 0.6))
        if 40 <= (np.abs(change) >= 0.3).sum() <= 48 and np.abs(change).max() <= 0.7:
            return change


def is_outlier(maps):
    found = outliers.find_patches(maps)
    return found.outliers(outliers._PATCH, outliers._SMALLEST_PATCH), found


@pytest.mark.parametrize("count", [10, 11])
def test_medians_are_those_of_the_others(count):
    values = np.random.default_rng(count).integers(0, 6, (count, 50)).astype(float)
    expected = [np.median(np.delete(values, n, axis=0), axis=0) for n in range(count)]
    np.testing.assert_array_equal(outliers.left_out_median(values), expected)


def test_a_voxel_too_many_is_found_and_sound_hemispheres_are_not():
    flags, hits, places = [], [], []
    for seed in range(SEED, SEED + 8):
        rng, (maps, _) = np.random.default_rng((seed, 1)), draw_cohort(seed)
        flags.append(is_outlier(maps)[0])
        for n in range(5):
            changed, change = maps.copy(), draw_damage(rng)
            changed[n] += change
            is_found, found = is_outlier(changed)
            hits.append(is_found[n])
            x, y = (axis[n] for axis in found.place)
            places.append(abs(change[x, y]) > 0.2 and found.size[n] * change[x, y] > 0)
    assert np.mean(flags) <= 0.02
    assert np.mean(hits) >= 0.9
    assert np.array(places)[hits].mean() >= 0.9


@pytest.mark.parametrize("effect", ["all", "CA1", "CA1-anterior"])
def test_an_effect_that_a_third_shares_makes_no_outliers(effect):
    flags = []
    for seed in range(SEED + 20, SEED + 24):
        maps, affected = draw_cohort(seed, effect=effect)
        flags.append(is_outlier(maps)[0][affected])
    assert np.mean(flags) <= 0.03


def test_missing_nodes_and_equal_maps_are_no_outliers():
    maps, _ = draw_cohort(SEED + 30, 12)
    maps[:, :3] = np.nan
    maps[4, 20:24, 9:12] = np.nan
    flags, found = is_outlier(maps)
    assert np.isfinite(found.score).all()
    assert not flags.any()
    assert not is_outlier(np.ones((12, *NODES)))[0].any()


def test_the_side_with_the_unusual_width_is_named():
    rng, count = np.random.default_rng(0), 20
    people = np.tile(rng.normal(9, 1.5, (count, 1)), (2, 1))
    values = people + rng.normal(0, 0.3, (2 * count, 6))
    sides, twins = np.repeat(["L", "R"], count), np.roll(np.arange(2 * count), count)
    values[4] -= 4 if values[4].mean() < 9 else -4
    found = outliers.find_numbers(values, sides, twins)
    flags = found.outliers(outliers._NUMBER, outliers._SMALLEST_NUMBER)
    assert np.flatnonzero(flags).tolist() == [4]
    assert found.place[1][4] == 1, "within a participant the sides are alike"
    np.testing.assert_allclose(abs(found.size[4]), 4, atol=1)


def write_hemisphere(root, subject, thickness, *, decision="use"):
    """Write what the table of measures is made from."""
    name = HemisphereName(subject=subject, session=None, hemi="L", seg="demo")
    place = ResultPlace(root=root, name=name)
    x, y = np.indices(thickness.shape).reshape(2, -1)
    subfield = np.where(x < 20, "Sub", "CA1")
    columns = ("x", "y", "r", "a", "s", "thickness", "subfield")
    numbers = (x + 1, y + 1, x - 30, y, 0 * x, thickness.ravel().round(4), subfield)
    files.write_tsv(
        place.path("sheet"), columns, zip(*(n.astype(str) for n in numbers), strict=True)
    )
    files.write_tsv(place.path("summary"), ("extent_x", "extent_y"), [("20.0", "25.0")])
    record = {"decision": decision, "input_hash": subject}
    place.path("qc").write_text(json.dumps(record))
    row = {key: str(record.get(key) or files.MISSING) for key in dataset.RECORDED}
    dataset.update_status(root, [row | dataset.identity(name)])


def test_the_table_names_size_place_and_hemisphere(tmp_path):
    maps, _ = draw_cohort(SEED + 40, 12)
    maps[3, 22:31, 8:13] += 0.9
    for n, values in enumerate(maps[:9]):
        write_hemisphere(tmp_path, f"{n:02d}", values)
    write_measures(tmp_path, complete=True)
    assert not read_compared(tmp_path), "nine are too few"
    for n, values in enumerate(maps[9:], start=9):
        write_hemisphere(tmp_path, f"{n:02d}", values)
    write_measures(tmp_path)
    assert not read_compared(tmp_path), "a part of a dataset is not compared"
    write_measures(tmp_path, complete=True)
    rows = read_compared(tmp_path)
    assert len(rows) == 12
    texts = {title: row["cohort_outlier"] for title, row in rows.items()}
    (title,) = (title for title, text in texts.items() if text != files.MISSING)
    assert title == "sub-03_hemi-L_seg-demo"
    assert texts[title].startswith(f"thickness {rows[title]['cohort_outlier_mm']} mm above")
    assert 0.5 < float(rows[title]["cohort_outlier_mm"]) < 1.3
    assert "CA1, RAS -" in texts[title]
    sidecar = json.loads((tmp_path / "measures.json").read_text())
    assert sidecar["cohort_outlier_mm"]["Units"] == "mm"
