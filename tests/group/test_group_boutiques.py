"""The group level by the real ``bosh``, on a cohort of simulated sheets."""

import shutil

import pytest
from bosh_cases import launch, outputs_found, outputs_missing, read_descriptor
from small_cohorts import write_dataset


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A cohort whose participant level was run in two parts, as platforms do."""
    root = tmp_path_factory.mktemp("cohort")
    write_dataset(root)
    (root / "out").rename(root / "part 1")
    shutil.copytree(root / "part 1", root / "part 2")
    for path in (root / "part 1").glob("sub-*"):
        odd = int(path.name[-1]) % 2
        shutil.rmtree(root / ("part 1" if odd else "part 2") / path.name)
    (root / "quick.toml").write_text("[classification]\nrepeats = 2\nfolds = 3\n")
    return root


@pytest.mark.long
def test_group_level_of_several_parts_leaves_all_outputs(folder):
    done = launch(
        folder,
        "hipsta_bids_group",
        bids_dir="bids",
        output_dir="all",
        derivatives=["part 1", "part 2"],
        settings="quick.toml",
        name="mine",
    )
    assert "Exit code\n0\n" in done.stdout, done.stdout
    assert "30 participants in the model" in done.stdout
    listed = {entry["id"] for entry in read_descriptor("hipsta_bids_group")["output-files"]}
    # What only --retest, --power, and hemispheres with other decisions than `use` write.
    absent = {"output_agreement", "output_sample_sizes", "output_quality"}
    assert outputs_found(done) == listed - absent
    assert outputs_missing(done) == ""


def test_a_model_of_volumes_lacks_nothing_that_is_promised(folder):
    """It has no maps: what such a model leaves out is optional."""
    done = launch(
        folder,
        "hipsta_bids_group",
        bids_dir="bids",
        output_dir="volumes",
        derivatives=["part 1", "part 2"],
        formula="volume ~ age",
        no_reports=True,
    )
    assert "Exit code\n0\n" in done.stdout, done.stdout
    assert outputs_missing(done) == ""
    found = outputs_found(done)
    assert {"output_measures", "output_record"} <= found
    maps = {"peaks", "statistics", "statistical_maps", "all_maps", "registration", "template"}
    assert not {f"output_{key}" for key in (*maps, "pages")} & found


@pytest.mark.long
def test_group_level_in_place_by_the_descriptor_of_both(folder):
    for path in (folder / "part 1").glob("sub-*"):
        stats = folder / "subjects" / path.name / "stats" / "aseg.stats"
        stats.parent.mkdir(parents=True)
        volume = 1.4e6 + 1e4 * int(path.name[-2:])
        stats.write_text(f"# Measure EstimatedTotalIntraCranialVol, eTIV, volume, {volume}, mm^3\n")
    done = launch(
        folder,
        "hipsta_bids",
        bids_dir="bids",
        output_dir="part 1",
        output_mount="part 1",
        analysis_level="group",
        segmentations=["subjects"],
        settings="quick.toml",
        align="none",
        name="mine",
    )
    assert "Exit code\n0\n" in done.stdout, done.stdout
    assert outputs_found(done) == {"output_dataset"}
    covariates = folder / "part 1" / "group" / "mine" / "covariates.tsv"
    assert "icv" in covariates.read_text(encoding="utf-8").splitlines()[0].split("\t")
