"""The suite of walls from shares: what is made of shares, and what its tables say."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from hipsta_bids.geometry.shares import wall_sd
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.types import LabelVolume
from validation import cases, soft
from validation.cases import Measured, Refusal
from validation.continuity import Movement
from validation.soft import LABELS, NOISY, SHARES, Timed
from validation.uncertainty import Coverage

CA1, SUBICULUM = int(Tissue.CA1), int(Tissue.SUBICULUM)
REFUSED = Refusal(reason="topology", message="a knot")
_NUMBERS = dict.fromkeys(("chance", "error", "sd", "mean_error", "mean_sd"), 0.3)
COVERED = dict.fromkeys((LABELS, SHARES), Coverage(covered=0.95, rank=0.6, **_NUMBERS))


def volume_of(share, voxel=0.4):
    """CA1 of the body with a share, background elsewhere."""
    inside = share > 0.5
    return LabelVolume(
        tissue=np.where(inside, CA1, 0).astype(np.uint8),
        part=np.where(inside, Part.BODY, 0).astype(np.uint8),
        affine=np.diag([voxel, voxel, voxel, 1.0]),
        protocol=load_protocol("freesurfer"),
        shares={0: (1 - share).astype(np.float32), CA1: share.astype(np.float32)},
    )


def wall(shape=(20, 12, 12), at=9.5):
    """Share of a half-space that begins at a place along the first axis, in voxels."""
    i = np.indices(shape)[0]
    return np.clip(i - at + 0.5, 0, 1)


def test_noise_is_in_voxels_of_the_wall_alone():
    share = np.clip(wall(at=9.3), 0, 1)
    noisy = soft.add_noise(volume_of(share), np.random.default_rng(0)).shares[CA1]
    mixed = (share > 0) & (share < 1)
    assert mixed.any()
    np.testing.assert_array_equal(noisy[~mixed], share[~mixed])
    assert np.std(noisy[mixed] - share[mixed]) == pytest.approx(soft.NOISE, rel=0.2)


def test_mixes_go_from_labels_to_shares():
    volume = volume_of(wall(at=9.3))
    for mix, wanted in ((0.0, volume.tissue == CA1), (1.0, volume.shares[CA1])):
        np.testing.assert_allclose(soft.mix_shares(volume, mix).shares[CA1], wanted)
    half = soft.mix_shares(volume, 0.5).shares[CA1]
    np.testing.assert_allclose(half, ((volume.tissue == CA1) + volume.shares[CA1]) / 2)


def test_a_blurred_wall_is_the_distribution_function():
    volume = volume_of((wall(at=9.5) > 0.6).astype(float), voxel=0.1)
    share = soft.blur_shares(volume, 0.4).shares[CA1][:, 6, 6]
    middle = np.arange(4, 16)
    expected = norm.cdf(0.1 * (middle - 9.5) / 0.4)
    np.testing.assert_allclose(share[middle], expected, atol=0.02)


def test_weights_become_shares_and_labels_with_the_part_beside_them():
    volume = volume_of(wall(at=9.5))
    i = np.indices(volume.tissue.shape)[0].astype(np.float32)
    found = soft.label_weights(
        volume, {0: 20 - i, CA1: np.full_like(i, 10), SUBICULUM: np.where(i > 15, 30, 0)}
    )
    assert sum(found.shares.values()) == pytest.approx(np.ones(i.shape))
    np.testing.assert_array_equal(
        found.tissue, np.where(i > 15, SUBICULUM, np.where(i > 10, CA1, 0))
    )
    np.testing.assert_array_equal(found.part, np.where(i > 10, Part.BODY, Part.UNKNOWN))


def test_noise_of_posteriors_is_correlated_and_as_large_as_stated_at_a_half():
    volume = volume_of(np.full((40, 40, 40), 0.5))
    weights = soft.noisy_weights(volume, np.random.default_rng(0))
    noise = soft.label_weights(volume, weights).shares[CA1] - 0.5
    assert noise.std() == pytest.approx(soft.NOISE, rel=0.1)
    near, far = (np.corrcoef(noise[:-n].ravel(), noise[n:].ravel())[0, 1] for n in (1, 10))
    assert near > 0.8
    assert abs(far) < 0.2


def measured(bias, spread=0.01, thickness=2.0):
    error = np.full((8, 8), bias)
    error[::2] += spread
    error[1::2] -= spread
    return Timed(
        result=Measured(
            thickness=thickness + error,
            true_thickness=np.full(error.shape, thickness),
            curvature={},
            true_curvature={},
            summary={},
            true_summary={},
            decision="use",
            flags=(),
        ),
        seconds=1.0,
    )


@pytest.mark.parametrize(
    ("results", "met"),
    [
        ([measured(0.003), measured(-0.009)], True),
        ([measured(0.003), measured(0.009)], False),
        ([measured(0.0, 0.03)], False),
        ([Timed(result=REFUSED)], False),
    ],
)
def test_shares_of_random_phantoms_are_judged(results, met):
    outcomes = [{LABELS: measured(0.1), SHARES: each, NOISY: each} for each in results]
    table = soft._random({"fine": outcomes})
    labels, shares, noisy = table.rows
    assert labels["met"] is None
    assert shares["met"] is noisy["met"] is met
    assert (labels["bias"], labels["SD"]) == ("+0.100", pytest.approx(0.01))


def test_a_phantom_that_was_not_drawn_lacks_all_forms():
    forms = {LABELS: measured(0.0), SHARES: measured(0.0), NOISY: measured(0.0)}
    table = soft._random({"fine": [forms, REFUSED]})
    assert [row["refused"] for row in table.rows] == [1, 1, 1]
    assert "fine, shares: topology: a knot" in table.notes


def mixes(*thickness):
    names = [LABELS, *map(soft._mix_name, soft.MIXES), SHARES]
    return {
        name: measured(0.0, thickness=each) for name, each in zip(names, thickness, strict=True)
    }


@pytest.mark.parametrize(("hard", "met"), [(2.005, True), (2.02, False)])
def test_steps_between_mixes_are_told(hard, met):
    steady = mixes(2.0, 2.0, 2.01, 2.02, 2.03, 2.04)
    (row,) = soft._continuity(
        {"fine": [steady, mixes(2.0, hard, 2.04, 2.04, 2.04, 2.10), {LABELS: measured(0.0)}]}
    ).rows
    assert (row["phantoms"], row["refused"], row["met"]) == (2, 0, met)
    assert float(row["0 beside labels, largest"]) == pytest.approx(hard - 2.0)
    assert row["largest step"] == pytest.approx(0.06)
    assert row["0 to 1"] == pytest.approx(cases.rms([0.04, 2.10 - hard]))


def test_a_mix_without_a_map_counts_as_refused():
    broken = mixes(*[2.0] * 6) | {SHARES: Timed(result=REFUSED)}
    (row,) = soft._continuity({"fine": [broken]}).rows
    assert (row["phantoms"], row["refused"], row["met"]) == (1, 1, False)


def moved(rms, r, mean=0.0):
    result = Movement(
        same_xy=rms,
        same_place=rms,
        correlation=r,
        mean=mean,
        far_off=0.0,
        accepted=True,
        reasons=(),
        choices=(),
    )
    return Timed(result=result, seconds=1.0)


@pytest.mark.parametrize(
    ("voxels", "results", "met"),
    [
        ("0.6 mm", [moved(0.13, 0.985), moved(0.14, 0.98), moved(0.2, 0.965)], True),
        ("0.6 mm", [moved(0.15, 0.99)], False),
        ("0.6 mm", [moved(0.1, 0.97)], False),
        ("0.6 mm", [moved(0.1, 0.99), moved(0.1, 0.99), moved(0.1, 0.95)], False),
        ("2 mm slices", [moved(0.3, 0.92, 0.02), moved(0.3, 0.9, -0.03)], True),
        ("2 mm slices", [moved(0.3, 0.92, 0.03), moved(0.3, 0.9, -0.03)], False),
        ("2 mm slices", [Timed(result=REFUSED)], False),
    ],
)
def test_maps_of_real_shapes_are_judged(voxels, results, met):
    outcomes = [{LABELS: moved(1.0, 0.0), SHARES: each} for each in results]
    labels, shares = soft._shapes({voxels: outcomes}).rows
    assert labels["met"] is None
    assert shares["met"] is met


def test_blurred_phantoms_have_a_row_per_kind_blur_and_form():
    specs = [soft.PhantomSpec(kind="arc", thickness=wall) for wall in (1.0, 1.4)]
    outcomes = [
        {(0.2, LABELS): measured(0.01), (0.2, SHARES): measured(0.02)},
        {(0.2, LABELS): Timed(result=REFUSED), (0.2, SHARES): measured(-0.02)},
    ]
    labels, shares = soft._blurred(specs, outcomes).rows
    assert labels["1.4 mm: decision"] == "topology"
    assert (shares["1 mm: bias"], shares["1.4 mm: bias"]) == ("+0.020", "-0.020")


def test_the_cost_is_the_median_ratio_over_hemispheres_with_both_maps():
    def forms(without, with_shares, result=None):
        labels = measured(0.0).result
        return {
            LABELS: Timed(result=labels, seconds=without),
            SHARES: Timed(result=result or labels, seconds=with_shares),
        }

    outcomes = [forms(2.0, 2.0), forms(2.0, 2.1), forms(2.0, 3.0), forms(2.0, 9.0, REFUSED)]
    (row,) = soft._cost({"fine": outcomes}).rows
    assert (row["hemispheres"], row["ratio"], row["met"]) == (3, pytest.approx(1.05), True)


def test_copies_by_probabilities_are_held_to_coverage_and_rank():
    labels, shares = soft._coverage([COVERED, COVERED, REFUSED]).rows
    assert (labels["copies of"], labels["met"]) == (LABELS, None)
    assert (shares["copies of"], shares["met"], shares["number"]) == (SHARES, True, 3)
    low = {name: replace(each, rank=0.45) for name, each in COVERED.items()}
    assert soft._coverage([low]).rows[1]["met"] is False


def test_walls_of_a_posterior_are_off_by_its_width():
    volume = volume_of(wall(shape=(30, 40, 40), at=14.5))
    for width in (0.1, 0.4):
        posterior = soft.draw_posterior(
            volume, np.full(volume.tissue.shape, width), np.random.default_rng(1)
        )
        share = posterior.shares[CA1]
        place = 0.4 * (30 - share.sum(axis=0)) - 0.4 * 15  # mm from the wall
        assert np.std(place) == pytest.approx(width, rel=0.3)
        assert abs(np.mean(place)) < 0.5 * width
        spread = np.mean(wall_sd(share, np.full(3, 0.4))[14:16, 8:-8, 8:-8])
        assert spread == pytest.approx(width, abs=0.08)


def test_the_quick_run_without_labels_has_no_real_shapes(monkeypatch):
    forms = {LABELS: measured(0.0), SHARES: measured(0.0), NOISY: measured(0.0)}
    monkeypatch.setattr(
        cases, "run_groups", lambda _, groups, **__: {key: [forms] for key in groups}
    )
    blurred = {(0.4, LABELS): measured(0.0)}
    runs = iter([[blurred], [COVERED]])
    monkeypatch.setattr(cases, "run_cases", lambda *_, **__: next(runs))
    suite = soft.run(full=False)
    names = ["random", "continuity", "blurred", "coverage", "cost"]
    assert [table.name for table in suite.tables] == names
    assert "`--labels`" in suite.text


@pytest.mark.long
def test_shares_of_a_thick_phantom_halve_the_error():
    results = soft.measure_random(("thick", soft.MIXED))
    errors = {name: np.nanstd(cases.without_edges(r.result.error)) for name, r in results.items()}
    assert list(results) == [LABELS, SHARES, NOISY]
    assert errors[SHARES] < 0.75 * errors[LABELS]
