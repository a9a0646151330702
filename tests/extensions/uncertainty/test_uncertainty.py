"""Uncertainty from perturbed copies: what copies are, and what the command line makes of them."""

import json
import shutil
from dataclasses import replace

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from measured_phantoms import measured, spiral
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import gaussian_filter, map_coordinates

from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.names import EXTRA_OUTPUTS
from hipsta_bids.errors import GeometryError
from hipsta_bids.extensions.uncertainty import copies as uncertainty
from hipsta_bids.extensions.uncertainty.copies import (
    add_uncertainty,
    estimate_uncertainty,
    find_modes,
    perturb,
)
from hipsta_bids.extensions.uncertainty.settings import UncertaintySettings
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.geometry.ends import EndPlane, EndPlanes
from hipsta_bids.participant import measure
from hipsta_bids.phantom import Hemisphere, Phantom, PhantomSpec, write_dataset
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.reports.cohort import read_cohort
from hipsta_bids.reports.participant import participant_page
from hipsta_bids.settings import Settings
from hipsta_bids.types import Decision, EditedMask, LabelVolume

SCHEME = load_protocol("freesurfer")
STILL = UncertaintySettings(relabeling=0.0, end_shift=0.0, jitter=0.0, rotation=0.0)
#: The size and the correlation lengths of displacements, mm.
DEFAULT = UncertaintySettings()


def planes(half_slice=0.2, uncertainty=0.0):
    """End planes 10 mm apart, of which the posterior one has no label."""
    axis = np.array([0.0, 0.6, -0.8])
    return EndPlanes(
        posterior=EndPlane(np.zeros(3), axis, "core", uncertainty),
        anterior=EndPlane(10 * axis, axis, "labels"),
        axis=axis,
        half_slice=half_slice,
    )


def volume_of(tissue, voxel=(1.0, 1.0, 1.0)):
    return LabelVolume(
        tissue=tissue,
        part=np.where(tissue > 0, 1, 0),
        affine=np.diag([*voxel, 1.0]),
        protocol=SCHEME,
    )


def box_of(volume):
    """Lowest and highest corner of what is labeled, mm, of a grid that is not turned."""
    index = np.argwhere(volume.tissue)
    voxel = np.diag(volume.affine)[:3]
    corners = np.array([index.min(axis=0) - 0.5, index.max(axis=0) + 0.5])
    return corners * voxel + volume.affine[:3, 3]


@pytest.fixture
def block():
    """A block between two voxel planes along each axis, with slices of 2 mm."""
    tissue = np.zeros((20, 20, 12), dtype=np.uint8)
    tissue[5:15, 5:15, 3:9] = Tissue.CA1
    return volume_of(tissue, (0.4, 0.4, 2.0))


@pytest.fixture(scope="module")
def drawn():
    return Phantom(spiral()).label_volume(SCHEME, voxel_size=(0.4,) * 3)


def test_a_shifted_grid_moves_boundaries_by_up_to_half_a_voxel(block):
    boxes = np.array([box_of(perturb(block, planes(), STILL, n)) for n in range(40)])
    moved = (boxes - box_of(block)) / np.array([0.4, 0.4, 2.0])
    assert np.abs(moved).max() <= 0.5 + 1e-9
    # 40 uniform values: their SD is known to 10 %
    np.testing.assert_allclose(moved.std(axis=0), np.full((2, 3), 1 / np.sqrt(12)), rtol=0.3)
    np.testing.assert_allclose(moved[:, 0], moved[:, 1], atol=1e-9)  # the size stays


def heights(copy, voxel, axis):
    """Where the plane of a half-space along an axis lies in a copy (N, M), mm."""
    inside = np.moveaxis(copy.tissue > 0, axis, 0)[:, 10:-10, 10:-10]
    top = inside.sum(axis=0) + np.argmax(inside, axis=0)
    return voxel[axis] * top + copy.affine[axis, 3]


@pytest.mark.parametrize("axis", range(3))
def test_displacements_have_the_size_and_lengths_of_the_settings_in_mm(axis):
    voxel = np.array([0.3, 0.4, 0.5])
    shape = np.round(40 / voxel).astype(int)
    shape[axis] = 24
    tissue = np.zeros(shape, dtype=np.uint8)
    half = [slice(2, -2)] * 3
    half[axis] = slice(2, 12)
    tissue[tuple(half)] = Tissue.CA1
    settings = STILL.changed(relabeling=DEFAULT.relabeling)
    copies = [perturb(volume_of(tissue, voxel), planes(), settings, n) for n in range(4)]
    rounding = voxel[axis] ** 2 / 12
    shift = np.array([heights(copy, voxel, axis) for copy in copies])
    shift -= shift.mean(axis=(1, 2), keepdims=True)  # where the copy's grid lies
    spread = shift.var() - rounding
    # 600 patches of the longer length: 3 % in theory, and the plane's overhangs.
    assert np.sqrt(spread) == pytest.approx(DEFAULT.relabeling, rel=0.07)
    along = np.delete(voxel, axis)[0]
    for steps in (round(1.2 / along), round(3 / along), round(9 / along)):
        expected = np.mean([np.exp(-((steps * along / s) ** 2)) for s in DEFAULT.correlation])
        pair = (shift[:, steps:] * shift[:, :-steps]).mean()
        assert pair / spread == pytest.approx(expected, abs=0.12)  # likewise


@pytest.mark.parametrize("relabeling", [0.0, 0.4])
def test_jitter_is_in_voxels_of_each_axis_and_part_of_what_people_draw(monkeypatch, relabeling):
    """How far the places of voxels move, as multiples of a voxel."""
    tissue = np.zeros((60, 60, 20), dtype=np.uint8)
    tissue[5:-5, 5:-5, 5:-5] = Tissue.CA1
    voxel = np.array([0.4, 0.5, 2.0])
    taken = []
    likeliest = uncertainty._likeliest
    monkeypatch.setattr(
        uncertainty, "_likeliest", lambda *args: taken.append(args[1]) or likeliest(*args)
    )
    errors = STILL.changed(jitter=0.9, relabeling=relabeling)
    for settings in (STILL, errors):
        perturb(volume_of(tissue, voxel), planes(), settings, 0)
    moved = (taken[1] - taken[0]).std(axis=1)
    # uniform by .9 voxels: more than .4 mm across the slices of 2 mm; 500 independent values
    np.testing.assert_allclose(moved, np.maximum(0.9 / np.sqrt(3), relabeling / voxel), rtol=0.06)


def test_noise_has_the_length_that_it_is_asked_for():
    generator = np.random.default_rng(1)
    shape = (60, 61, 62)
    for length in ([1.0, 1.0, 1.0], [2.0, 4.0, 3.0]):
        noise = uncertainty._smooth_noise(shape, np.array(length), generator).reshape(shape)
        assert noise.std() == pytest.approx(1.0, rel=0.05)  # 2000 independent values or more
        for axis, reach in enumerate(length):
            for step in (round(reach), round(2 * reach)):
                ahead = np.take(noise, range(step, shape[axis]), axis=axis)
                behind = np.take(noise, range(shape[axis] - step), axis=axis)
                expected = np.exp(-((step / reach) ** 2))
                assert (ahead * behind).mean() == pytest.approx(expected, abs=0.08)  # likewise


@pytest.mark.parametrize(
    ("half_slice", "error", "sd"), [(0.2, 0.0, 0.2), (1.0, 0.4, 1.0), (0.2, 0.9, 0.9)]
)
def test_ends_move_by_half_a_slice_or_by_their_standard_error(block, half_slice, error, sd):
    ends = planes(half_slice, error)
    generator = np.random.default_rng(4)
    moves = [uncertainty._moved_ends(block, ends, DEFAULT, generator) for _ in range(400)]
    for number, (name, expected) in enumerate({"posterior": sd, "anterior": half_slice}.items()):
        assert {move[number].end for move in moves} == {name}
        points = np.array([move[number].point for move in moves])
        shifts = (points - ends[name].point) @ ends.axis
        beside = points - shifts[:, None] * ends.axis
        np.testing.assert_allclose(beside, beside[:1].repeat(400, axis=0), atol=1e-9)
        assert shifts.std() == pytest.approx(expected, rel=0.15)  # 400 values: 4 %
        assert abs(shifts.mean()) < 0.2 * expected


def test_a_copy_ends_at_the_moved_planes(drawn):
    ends = extract_body(drawn, Settings().body).ends
    copy = perturb(drawn, ends, DEFAULT, 0)
    moved = extract_body(copy, Settings().body).ends
    for given in copy.given_ends:
        assert abs(moved.height(np.array([given.point]), given.end)[0]) < 1e-9
        assert abs(ends.height(np.array([given.point]), given.end)[0]) > 1e-3  # a draw of SD .2 mm
    assert perturb(drawn, ends, STILL, 0).given_ends == drawn.given_ends == ()


def test_planes_are_given_by_a_point_of_the_body(drawn):
    """That of an end without a label may lie anywhere on its plane."""
    ends = extract_body(drawn, Settings().body).ends
    aside = np.cross(ends.axis, ends.posterior.normal + np.eye(3)[0])
    aside -= (aside @ ends.posterior.normal) * ends.posterior.normal
    far = replace(ends, posterior=ends.posterior._replace(point=ends.posterior.point + 90 * aside))
    near, moved = (perturb(drawn, planes, DEFAULT, 0).given_ends[0].point for planes in (ends, far))
    np.testing.assert_allclose(near, moved, atol=1e-9)


def test_the_likeliest_label_is_that_of_linear_interpolation():
    generator = np.random.default_rng(2)
    codes = generator.integers(0, 5, (9, 8, 7))
    places = generator.uniform(1, 5.5, (3, 500))
    shares = [map_coordinates((codes == c) * 1.0, places, order=1) for c in range(5)]
    np.testing.assert_array_equal(uncertainty._likeliest(codes, places), np.argmax(shares, axis=0))


def test_copies_are_those_of_the_labels(drawn):
    ends = planes()
    one, again, other = (perturb(drawn, ends, DEFAULT, n) for n in (0, 0, 1))
    np.testing.assert_array_equal(one.tissue, again.tissue)
    assert one.tissue.shape != other.tissue.shape or (one.tissue != other.tissue).any()
    # What lies round the labels in the file makes no difference.
    wide = replace(drawn, tissue=np.pad(drawn.tissue, 5), part=np.pad(drawn.part, 5))
    affine = drawn.affine.copy()
    affine[:3, 3] -= affine[:3, :3] @ [5, 5, 5]
    np.testing.assert_array_equal(
        perturb(replace(wide, affine=affine), ends, DEFAULT, 0).tissue[one.tissue > 0],
        one.tissue[one.tissue > 0],
    )
    # Every tissue of every part keeps its size, but for what a person draws elsewhere.
    one = perturb(drawn, ends, DEFAULT.changed(relabeling=0.0), 0)
    for tissue in np.unique(drawn.tissue[drawn.tissue > 0]):
        for part in np.unique(drawn.part[drawn.tissue == tissue]):
            before, after = (np.sum((v.tissue == tissue) & (v.part == part)) for v in (drawn, one))
            assert after == pytest.approx(before, rel=0.1)  # thin bands lose a little


def test_an_edited_mask_goes_along(drawn):
    inside = np.isin(drawn.tissue, SCHEME.sheet)
    edited = replace(drawn, edited_mask=EditedMask(inside=inside, voxel=0.4))
    copy = perturb(edited, planes(), DEFAULT, 0)
    same = copy.edited_mask.inside == np.isin(copy.tissue, SCHEME.sheet)
    assert same.mean() > 0.999  # a vote between more kinds may end otherwise
    assert copy.edited_mask.inside.sum() == pytest.approx(inside.sum(), rel=0.05)
    assert copy.edited_mask.voxel == 0.4


def test_spread_is_that_of_the_copies_that_could_be_measured(drawn, monkeypatch):
    random = np.random.default_rng(3)
    maps = [random.normal(2, 0.1, (4, 3)) for _ in range(6)]
    maps[1][0, 0] = np.nan
    queue = iter(maps)

    def measure(*_):
        values = next(queue)
        if values is maps[4]:
            raise GeometryError("thin; look", reason="too-thin")
        return {"thickness": values}, {"thickness_mean": float(np.nanmean(values))}

    monkeypatch.setattr(uncertainty, "perturb", lambda *_: None)
    monkeypatch.setattr(uncertainty, "_measure", measure)
    found = estimate_uncertainty(drawn, "L", Settings(), 6)
    kept = np.array([m for m in maps if m is not maps[4]])
    # Variances are averaged over a node to each side, the outermost ones continued.
    variances = np.pad(np.nanstd(kept, axis=0, ddof=1) ** 2, 1, mode="edge")
    means = sliding_window_view(variances, (3, 3)).mean(axis=(2, 3))
    np.testing.assert_allclose(found.maps["thickness"], np.sqrt(means))
    means = [np.nanmean(m) for m in kept]
    assert found.summary["thickness_mean"] == pytest.approx(np.std(means, ddof=1))
    assert (found.failed, found.notes) == (1, [])
    assert found.metrics["uncertainty_failed"] == 1
    assert (found.modes, found.metrics["uncertainty_modes"]) == (None, 1)


def test_copies_measure_no_second_choices(drawn, monkeypatch):
    find, unfold, sheets = measure._boundaries, uncertainty.unfold, []

    def doubtful(*args):
        boundaries = find(*args)
        return replace(boundaries, rival=boundaries)

    def spy(*args, **options):
        sheets.append(unfold(*args, **options))
        return sheets[-1]

    monkeypatch.setattr(measure, "_boundaries", doubtful)
    monkeypatch.setattr(uncertainty, "unfold", spy)
    settings = Settings().changed(grid={"spacing": 0.5})
    uncertainty._measure(drawn, "L", settings)
    whole = unfold(drawn, "L", settings, uncertainty._no_clock)
    assert (len(sheets[0].rivals), len(whole.rivals)) == (0, 1)


def test_no_spread_if_most_copies_fail(drawn, monkeypatch):
    def measure(*_):
        raise GeometryError("thin; look", reason="too-thin")

    monkeypatch.setattr(uncertainty, "_measure", measure)
    found = estimate_uncertainty(drawn, "L", Settings(), 2)
    assert not found.known
    assert found.metrics["uncertainty_thickness_mm"] is None
    assert found.metrics["uncertainty_modes"] is None
    assert "2 of 2 perturbed copies could not be measured" in found.notes[0]


def maps_of(seed, second=0, distance=0.0, count=8):
    """Maps with smooth noise of SD .2 as real copies have; ``second`` of them differ in a third."""
    random = np.random.default_rng(seed)
    maps = [gaussian_filter(random.normal(size=(41, 21)), 1.5) for _ in range(count)]
    maps = [2 + 0.2 * values / values.std() for values in maps]
    for number in range(second):
        maps[2 * number][28:] += distance
    return maps


def test_two_groups_of_copies_are_two_modes():
    for seed in range(20):
        modes = find_modes(maps_of(seed, second=3, distance=1.0), Settings().checks)
        # Noise of SD .2 of the mean of 3 copies, in a third of the columns.
        assert modes.value == pytest.approx(np.sqrt(13 / 41), abs=0.1)
        assert modes.share == pytest.approx(13 / 41, abs=0.1)
        assert modes.raised
        assert "(5 and 3 copies)" in modes.text or "(3 and 5 copies)" in modes.text


def test_one_group_is_one_mode():
    checks = Settings().checks
    for count in (4, 8, 16):
        assert not [s for s in range(100) if find_modes(maps_of(s, count=count), checks)]
    # An odd copy is no mode, and three copies have none.
    assert find_modes(maps_of(1, second=1, distance=2.0), checks) is None
    assert find_modes(maps_of(1, second=2, distance=2.0, count=3), checks) is None


def test_columns_that_a_copy_lacks_do_not_count():
    maps = maps_of(2, second=3, distance=1.0)
    maps[1][:20] = np.nan
    before = find_modes([values[20:] for values in maps], Settings().checks)
    assert find_modes(maps, Settings().checks).value == pytest.approx(before.value)


def test_modes_are_recorded_and_flag_a_map(drawn, monkeypatch):
    queue = iter(maps_of(3, second=3, distance=1.0))
    monkeypatch.setattr(uncertainty, "perturb", lambda *_: None)
    monkeypatch.setattr(
        uncertainty, "_measure", lambda *_: ({"thickness": next(queue)}, {"thickness_mean": 2.0})
    )
    maps = measured(spiral()).maps
    spread = estimate_uncertainty(drawn, "L", Settings(), 8)
    flagged = add_uncertainty(maps, spread)
    assert flagged.qc["uncertainty_modes"] == 2
    assert flagged.qc["uncertainty_modes_mm"] > Settings().checks.flag_rival
    (flag,) = set(flagged.flags) - set(maps.flags)
    assert flag.reason == "second-choice"
    assert 0 < flag.share < 1
    assert flagged.decision == Decision.LOOK
    alike = replace(spread, modes=replace(spread.modes, value=0.1))
    assert add_uncertainty(maps, alike).flags == maps.flags


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The same dataset without and with uncertainty; one subject with both hemispheres."""
    root = tmp_path_factory.mktemp("uncertainty")
    spec = PhantomSpec(kind="arc", thickness=2.0, length=8.0)
    hemispheres = [Hemisphere(subject="01", hemi=hemi, spec=spec) for hemi in "LR"]
    write_dataset(root / "bids", hemispheres, voxel_size=(0.5, 0.5, 0.5))
    # mm; these tests look at what is written
    (root / "coarse.toml").write_text("[grid]\nspacing = 0.5\n")
    run(root, "plain")
    run(root, "spread", "--uncertainty", "2")
    return root


def run(root, out, *options):
    settings = ["--settings", str(root / "coarse.toml"), "--no-reports"]
    command = [str(root / "bids"), str(root / out), "participant", *settings, *options]
    assert main(command) == 0


def contents(folder):
    return {p.name: p.read_bytes() for p in sorted((folder / "sub-01").rglob("*")) if p.is_file()}


def file_of(root, out, ending, hemi="L"):
    (path,) = (root / out / "sub-01" / "anat").glob(f"*_hemi-{hemi}_seg-*_{ending}")
    return path


def test_results_are_the_same_to_the_last_byte(runs):
    plain, spread = contents(runs / "plain"), contents(runs / "spread")
    records = {name for name in plain if name.endswith("desc-qc_metrics.json")}
    assert len(records) == 2
    for name in plain.keys() - records:
        assert plain[name] == spread[name], name
    new = spread.keys() - plain.keys()
    rows = [row for row in EXTRA_OUTPUTS if not row.key.startswith("template")]
    descs = {row.desc for row in rows if "ncertain" in row.key or row.key.endswith("_sd")}
    assert {name.split("_desc-")[1].split("_")[0] for name in new} == descs
    for name in records:
        before, after = json.loads(plain[name]), json.loads(spread[name])
        own = {k: v for k, v in after["metrics"].items() if k.startswith("uncertainty")}
        assert len(own) == 6
        after["metrics"] = {k: v for k, v in after["metrics"].items() if k not in own}
        assert before == after
        assert (own["uncertainty_copies"], own["uncertainty_failed"]) == (2, 0)


def test_tables_tell_the_spread_of_every_measure(runs):
    table = pd.read_csv(file_of(runs, "spread", "desc-uncertainty_morph.tsv"), sep="\t")
    sheet = pd.read_csv(file_of(runs, "spread", "desc-sheet_morph.tsv"), sep="\t")
    assert list(table) == ["x", "y", *(f"{row.name}_sd" for row in MAPS)]
    pd.testing.assert_frame_equal(table[["x", "y"]], sheet[["x", "y"]])
    assert 0.01 < table.thickness_sd.median() < 0.3  # mm; half a voxel is .25
    sidecar = json.loads(file_of(runs, "spread", "desc-uncertainty_morph.json").read_text())
    assert sidecar["thickness_sd"]["Units"] == "mm"
    assert sidecar["thickness_sd"]["Description"].startswith("SD over 2 perturbed copies")
    surface = nib.load(file_of(runs, "spread", "desc-thicknessSd_morph.shape.gii"))
    np.testing.assert_allclose(surface.darrays[0].data, table.thickness_sd, atol=1e-4)  # digits
    row = pd.read_csv(file_of(runs, "spread", "desc-summaryuncertainty_morph.tsv"), sep="\t")
    summary = pd.read_csv(file_of(runs, "spread", "desc-summary_morph.tsv"), sep="\t")
    assert list(row) == [f"{name}_sd" for name in summary]
    assert 0 < row.thickness_mean_sd[0] < table.thickness_sd.median()
    text = json.loads(file_of(runs, "spread", "desc-summaryuncertainty_morph.json").read_text())
    assert text["volume_sd"]["Units"] == "mm^3"
    record = json.loads(file_of(runs, "spread", "desc-qc_metrics.json").read_text())
    median = record["metrics"]["uncertainty_thickness_mm"]
    assert median == pytest.approx(table.thickness_sd.median(), abs=1e-4)


@pytest.mark.long
def test_copies_are_made_once_and_again_for_another_number(runs):
    shutil.copytree(runs / "plain", runs / "again")
    run(runs, "again", "--uncertainty", "2", "--n-procs", "1")  # what was there lacked it
    assert contents(runs / "again") == contents(runs / "spread")
    path = file_of(runs, "again", "desc-qc_metrics.json")
    written = path.stat().st_mtime_ns
    run(runs, "again", "--uncertainty", "2")
    run(runs, "again")
    assert path.stat().st_mtime_ns == written
    run(runs, "again", "--uncertainty", "3", "--hemi", "L")
    assert json.loads(path.read_text())["metrics"]["uncertainty_copies"] == 3


def test_one_copy_is_refused(runs, capsys):
    command = [str(runs / "bids"), str(runs / "none"), "participant", "--uncertainty", "1"]
    assert main(command) == 64
    assert "use 0, or 2 or more" in capsys.readouterr().err
    assert not (runs / "none").exists()


def test_pages_show_the_spread_where_there_is_one(runs):
    pages = {
        out: participant_page(runs / out, "01", None, read_cohort(runs / out))
        for out in ("plain", "spread")
    }
    assert "SD of thickness" not in pages["plain"]
    assert "left: SD of thickness over 2 perturbed copies" in pages["spread"]
    assert pages["spread"].count("SD of thickness on the unfolded sheet") == 1
