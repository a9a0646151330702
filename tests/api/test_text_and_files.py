"""What objects of the interface show of themselves, the files they write, and their errors."""

import base64
import re
import shutil
from dataclasses import replace

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from measured_phantoms import measured, spiral
from PIL import Image

import hipsta_bids as hb
from hipsta_bids.api import datasets
from hipsta_bids.api.maps import Measurement
from hipsta_bids.derivatives.dataset import read_status
from hipsta_bids.errors import HipstaError, MissingFileError, UsageError
from hipsta_bids.group.cohort.collect import GroupRequest, collect_sheets
from hipsta_bids.io import files
from hipsta_bids.phantom import encode
from hipsta_bids.settings import Settings
from hipsta_bids.types import Flag


def phantom(side="L"):
    return measured(spiral(), hemi=side, voxel=0.5)


@pytest.fixture(scope="module")
def left():
    return hb.measure(phantom().volume, side="L")


@pytest.fixture(scope="module")
def flagged():
    message = "CA1 at RAS 1 2 3 mm: <two> sheets touch. Check the labels there."
    maps = replace(phantom().maps, flags=(Flag(reason="folded", message=message, share=0.1),))
    return Measurement(
        side="L", protocol=phantom().volume.protocol, settings=Settings(), hemisphere=maps
    )


@pytest.fixture(scope="module")
def saved(left, tmp_path_factory):
    root = tmp_path_factory.mktemp("saved")
    left.save(root, "sub-01", "ses-1")
    hb.measure(phantom("R").volume, side="R").save(root, "01", "1")
    return root


def fit():
    random = np.random.default_rng(1)
    table = pd.DataFrame({"group": ["CN"] * 10 + ["AD"] * 10, **random_columns(20)})
    formula = " + ".join(table.columns)
    contrasts = list(table.columns[1:])
    return hb.group({s: random.normal(2, 0.1, (20, 6, 4)) for s in "LR"}, table, formula,
                    contrasts=contrasts)  # fmt: skip


def random_columns(rows):
    random = np.random.default_rng(2)
    return {f"score{number}": random.normal(size=rows) for number in range(9)}


class TestText:
    def test_all_are_short(self, left, flagged, saved):
        for shown in (left, flagged, hb.load(saved), fit()):
            text = repr(shown)
            assert len(text.splitlines()) <= 15
            assert len(text) < 2000

    def test_a_measurement_names_decision_and_numbers(self, left, flagged):
        assert repr(left).splitlines()[0].endswith("(left, freesurfer, body): use")
        volume = left.summary["volume"]
        assert re.search(rf"volume +{volume:.2f} mm³", repr(left))
        assert repr(flagged).splitlines()[0].endswith(f"look: {flagged.message}")

    def test_a_card_has_the_map(self, flagged, tmp_path):
        card = flagged._repr_html_()
        assert "&lt;two&gt; sheets touch" in card
        code = re.search(r'src="data:image/png;base64,([^"]+)"', card)[1]
        (tmp_path / "map.png").write_bytes(base64.b64decode(code))
        pixels = np.asarray(Image.open(tmp_path / "map.png").convert("RGB"))
        colors = np.unique(pixels.reshape(-1, 3), axis=0)
        assert len(colors) > 100  # of a map and its scale
        assert len(card) < 60_000

    def test_cards_of_tables_have_their_rows(self, saved):
        card = hb.load(saved)._repr_html_()
        assert "Output dataset of 2 hemispheres" in card
        assert card.count("sub-01") == 2
        assert fit()._repr_html_().count("<tr") <= 10
        assert "significant" in fit()._repr_html_()


class TestFiles:
    def test_what_is_saved_is_loaded(self, left, saved):
        maps, measures = hb.load(saved)
        own = maps.sel(participant="sub-01", session="ses-1", side="L").squeeze()
        np.testing.assert_allclose(own.thickness, left.maps["thickness"], atol=6e-5)
        np.testing.assert_array_equal(own.subfield, left.subfield)
        assert measures["hemi"].tolist() == ["L", "R"]
        assert measures["decision"].tolist() == ["use", "use"]
        table = pd.read_csv(saved / "measures.tsv", sep="\t")
        np.testing.assert_allclose(table["volume"], measures["volume"])
        assert [row["decision"] for row in read_status(saved)] == ["use", "use"]

    def test_the_group_level_takes_it(self, saved):
        found = collect_sheets(GroupRequest(roots=(saved,)))
        assert [record.result.name.hemi for record in found.records] == ["L", "R"]
        assert found.exclusions == ()
        assert found.warnings == ()

    def test_it_is_a_dataset(self, saved):
        described = files.read_json(saved / "dataset_description.json")
        assert described["DatasetType"] == "derivative"

    def test_saving_again_replaces(self, left, flagged, tmp_path):
        assert left.save(tmp_path, "01") == tmp_path
        flagged.save(tmp_path, "01")
        assert hb.load(tmp_path).measures["decision"].tolist() == ["look"]
        (row,) = read_status(tmp_path)
        assert (row["decision"], row["reason"]) == ("look", "folded")

    def test_other_settings_or_labels_are_refused(self, left, saved, tmp_path):
        other = replace(left, settings=left.settings.changed(sheet={"x_nodes": 21}))
        with pytest.raises(UsageError, match=r"sheet\.x_nodes was 41, now 21"):
            other.save(saved, "02")
        for labels in (("sub-0_1",), ("01", "ses-ä")):
            with pytest.raises(ValueError, match="letters and digits only"):
                left.save(tmp_path, *labels)
            with pytest.raises(ValueError, match="letters and digits only"):
                left.to_gifti(tmp_path, *labels)

    def test_gifti_has_surfaces_and_maps(self, left, tmp_path):
        folder = left.to_gifti(tmp_path / "new", "sub-01", "2")
        stem = "sub-01_ses-2_hemi-L_seg-freesurfer"
        values = nib.load(folder / f"{stem}_thickness.shape.gii").darrays[0].data
        np.testing.assert_allclose(values, left.maps["thickness"].ravel(), rtol=1e-6)
        surface = nib.load(folder / f"{stem}_midthickness.surf.gii")
        np.testing.assert_allclose(surface.darrays[0].data, left.surface().points, atol=1e-4)
        assert {path.suffix for path in folder.iterdir()} == {".gii"}

    def test_gifti_of_a_fit(self, tmp_path):
        found = fit()
        folder = found.to_gifti(tmp_path)
        name = "hemi-R_contrast-Score0_stat-t_desc-maps_statmap.shape.gii"
        values = nib.load(folder / name).darrays[0].data
        expected = found.maps["statistic"][found.sides.index("R"), found.contrasts.index("score0")]
        np.testing.assert_allclose(values, expected.ravel(), rtol=1e-6)


class TestErrors:
    def test_a_missing_file_is_the_error_of_python(self, tmp_path):
        codes, affine = encode(phantom().volume), phantom().volume.affine
        gone = tmp_path / "gone"
        table, maps = pd.DataFrame({"age": np.arange(12.0)}), np.ones((12, 3, 3))
        calls = [
            lambda: hb.load(gone),
            lambda: hb.measure(gone.with_suffix(".nii.gz"), "L", "freesurfer"),
            lambda: hb.measure(codes, "L", gone.with_suffix(".toml"), affine=affine),
            lambda: hb.measure(codes, "L", "freesurfer", affine=affine, settings=gone),
            lambda: hb.group(maps, table, "age", settings=gone),
            lambda: hb.register({"curvature": maps}, settings=gone),
        ]
        for call in calls:
            with pytest.raises(FileNotFoundError, match=str(gone)) as caught:
                call()
            assert isinstance(caught.value, MissingFileError)
            assert caught.value.filename is None  # the message has it

    @pytest.mark.parametrize(
        ("call", "message"),
        [
            (lambda codes: hb.measure(codes, "L", "hippunfold"), "pass it with protocol="),
            (lambda codes: hb.measure(codes, "L", "hippunfold", region="extended"), "protocol="),
            (lambda _: hb.group(np.ones((4, 3)), pd.DataFrame({"a": range(4)}), ""), "formula= is"),
        ],
    )
    def test_messages_name_arguments(self, call, message):
        image = nib.Nifti1Image(encode(phantom().volume).astype(np.int16), np.diag([0.5] * 3 + [1]))
        with pytest.raises(HipstaError, match=message) as caught:
            call(image)
        assert "--" not in str(caught.value)


class TestExample:
    def test_it_is_made_once(self):
        study, again = hb.example(), hb.example()
        assert again.out_dir == study.out_dir
        again.participants["group"] = "nobody's"
        assert study.participants["group"].tolist() == ["CN", "AD"] * 5
        maps, measures = hb.load(study.out_dir)
        assert measures["participant_id"].tolist() == study.participants["participant_id"].tolist()
        means = measures.merge(study.participants).groupby("group")["thickness_mean_CA1"].mean()
        assert 0.05 < means["CN"] - means["AD"] < 0.3  # planted in the anterior part
        first = hb.measure(study.labels, "L", "freesurfer").maps["thickness"]
        own = maps.thickness.sel(participant="sub-01", side="L").squeeze()
        np.testing.assert_allclose(first, own, atol=2e-4)  # headers are in single precision

    def test_a_named_folder_is_taken_up(self, tmp_path, monkeypatch):
        study = hb.example()
        shutil.copytree(study.out_dir, tmp_path, dirs_exist_ok=True)
        monkeypatch.setattr(datasets, "measure", None)
        again = hb.example(tmp_path)
        assert again.out_dir == tmp_path
        pd.testing.assert_frame_equal(again.participants, study.participants)
