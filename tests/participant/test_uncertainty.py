"""Uncertainty from perturbed copies: what copies are, and what the command line makes of them."""

import json
import shutil
from dataclasses import replace

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from measured_phantoms import spiral
from scipy.ndimage import map_coordinates

from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.names import EXTRA_OUTPUTS
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.participant import uncertainty
from hipsta_bids.participant.uncertainty import estimate_uncertainty, perturb
from hipsta_bids.phantom import Hemisphere, Phantom, PhantomSpec, write_dataset
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.reports.cohort import read_cohort
from hipsta_bids.reports.participant import participant_page
from hipsta_bids.settings import Settings, UncertaintySettings
from hipsta_bids.types import EditedMask, LabelVolume

SCHEME = load_protocol("freesurfer")
STILL = UncertaintySettings(jitter=0.0, rotation=0.0)


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
    boxes = np.array([box_of(perturb(block, STILL, n)) for n in range(40)])
    moved = (boxes - box_of(block)) / np.array([0.4, 0.4, 2.0])
    assert np.abs(moved).max() <= 0.5 + 1e-9
    # 40 uniform values: their SD is known to 10 %
    np.testing.assert_allclose(moved.std(axis=0), np.full((2, 3), 1 / np.sqrt(12)), rtol=0.3)
    np.testing.assert_allclose(moved[:, 0], moved[:, 1], atol=1e-9)  # the size stays


def test_jitter_is_the_settings_in_voxels_of_each_axis():
    """A half-space along each axis: how far its plane moves."""
    for axis in range(3):
        tissue = np.zeros((40, 40, 40), dtype=np.uint8)
        half = [slice(2, 38)] * 3
        half[axis] = slice(2, 20)
        tissue[tuple(half)] = Tissue.CA1
        settings = UncertaintySettings(jitter=1.5, correlation=4.0, rotation=0.0)
        copies = [perturb(volume_of(tissue, (0.5, 1.0, 2.0)), settings, n) for n in range(6)]
        heights = []
        for copy in copies:
            inside = np.moveaxis(copy.tissue > 0, axis, 0)[:, 12:30, 12:30]
            start = copy.affine[axis, 3] / [0.5, 1.0, 2.0][axis]
            heights.append(inside.sum(axis=0) + np.argmax(inside, axis=0) + start)
        spread = np.concatenate([h.ravel() for h in heights]).std()
        # uniform by 1.5 voxels, and rounding to voxels of the copy: 1.5^2 / 3 + 1 / 12
        assert spread == pytest.approx(np.sqrt(0.75 + 1 / 12), rel=0.25)  # few independent places


def test_noise_has_the_length_that_it_is_asked_for():
    generator = np.random.default_rng(1)
    for length in (1.0, 2.0):
        noise = uncertainty._smooth_noise((60, 60, 60), length, generator).reshape(60, 60, 60)
        assert noise.std() == pytest.approx(1.0, rel=0.03)  # 5000 independent values or more
        step = round(length * 2)  # exp(-(2 length)^2 / length^2) = exp(-4)
        for axis in range(3):
            pair = noise * np.roll(noise, step, axis=axis)
            assert pair.mean() == pytest.approx(
                np.exp(-((step / length) ** 2)), abs=0.05
            )  # likewise


def test_the_likeliest_label_is_that_of_linear_interpolation():
    generator = np.random.default_rng(2)
    codes = generator.integers(0, 5, (9, 8, 7))
    places = generator.uniform(1, 5.5, (3, 500))
    shares = [map_coordinates((codes == c) * 1.0, places, order=1) for c in range(5)]
    np.testing.assert_array_equal(uncertainty._likeliest(codes, places), np.argmax(shares, axis=0))


def test_copies_are_those_of_the_labels(drawn):
    settings = UncertaintySettings()
    one, again, other = (perturb(drawn, settings, n) for n in (0, 0, 1))
    np.testing.assert_array_equal(one.tissue, again.tissue)
    assert one.tissue.shape != other.tissue.shape or (one.tissue != other.tissue).any()
    # What lies round the labels in the file makes no difference.
    wide = replace(drawn, tissue=np.pad(drawn.tissue, 5), part=np.pad(drawn.part, 5))
    affine = drawn.affine.copy()
    affine[:3, 3] -= affine[:3, :3] @ [5, 5, 5]
    np.testing.assert_array_equal(
        perturb(replace(wide, affine=affine), settings, 0).tissue[one.tissue > 0],
        one.tissue[one.tissue > 0],
    )
    # Every tissue of every part keeps its size.
    for tissue in np.unique(drawn.tissue[drawn.tissue > 0]):
        for part in np.unique(drawn.part[drawn.tissue == tissue]):
            before, after = (np.sum((v.tissue == tissue) & (v.part == part)) for v in (drawn, one))
            assert after == pytest.approx(before, rel=0.1)  # thin bands lose a little


def test_an_edited_mask_goes_along(drawn):
    inside = np.isin(drawn.tissue, SCHEME.sheet)
    edited = replace(drawn, edited_mask=EditedMask(inside=inside, voxel=0.4))
    copy = perturb(edited, UncertaintySettings(), 0)
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
    np.testing.assert_allclose(found.maps["thickness"], np.nanstd(kept, axis=0, ddof=1))
    means = [np.nanmean(m) for m in kept]
    assert found.summary["thickness_mean"] == pytest.approx(np.std(means, ddof=1))
    assert (found.failed, found.notes) == (1, [])
    assert found.metrics["uncertainty_failed"] == 1


def test_no_spread_if_most_copies_fail(drawn, monkeypatch):
    def measure(*_):
        raise GeometryError("thin; look", reason="too-thin")

    monkeypatch.setattr(uncertainty, "_measure", measure)
    found = estimate_uncertainty(drawn, "L", Settings(), 2)
    assert not found.known
    assert found.metrics["uncertainty_thickness_mm"] is None
    assert "2 of 2 perturbed copies could not be measured" in found.notes[0]


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
    descs = {row.desc for row in EXTRA_OUTPUTS if "ncertain" in row.key or row.key.endswith("_sd")}
    assert {name.split("_desc-")[1].split("_")[0] for name in new} == descs
    for name in records:
        before, after = json.loads(plain[name]), json.loads(spread[name])
        own = {k: v for k, v in after["metrics"].items() if k.startswith("uncertainty")}
        assert len(own) == 4
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
