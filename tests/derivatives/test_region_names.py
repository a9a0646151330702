"""Results of several regions side by side in one folder."""

from dataclasses import replace

import pytest

from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.dataset import identity, read_status, update_status
from hipsta_bids.derivatives.hemisphere import remove_results
from hipsta_bids.derivatives.names import (
    DATASET_FILES,
    OUTPUTS,
    HemisphereName,
    output_name,
)
from hipsta_bids.derivatives.results import ResultPlace
from hipsta_bids.errors import SettingsError
from hipsta_bids.io import files
from hipsta_bids.settings import BodySettings, Settings

BODY = HemisphereName(subject="01", session=None, hemi="L", seg="P")
LONGER = replace(BODY, region="extended")


def test_the_region_is_the_label_entity():
    expected = "sub-01_hemi-L_space-unfold_seg-P_label-extended_interior.surf.gii"
    assert output_name(LONGER, "interior_unfold") == expected
    expected = "sub-01_hemi-L_seg-P_label-extended_desc-sheet_morph.tsv"
    assert output_name(LONGER, "sheet") == expected
    assert "label-" not in output_name(BODY, "sheet")


def test_leftovers_of_other_regions_stay(tmp_path):
    """A killed run's; another region may just be written by another process."""
    places = {name: ResultPlace(root=tmp_path, name=name) for name in (BODY, LONGER)}
    for kept, removed in ((BODY, LONGER), (LONGER, BODY)):
        for place in places.values():
            for row in OUTPUTS:
                path = place.path(row.key)
                files.write_text(path, "x")
                path.with_name(f".{path.name}.7.tmp").write_text("x", encoding="utf-8")
        remove_results(places[removed])
        left = {path.name.lstrip(".") for path in (tmp_path / BODY.folder).iterdir()}
        names = {output_name(kept, row.key) for row in OUTPUTS}
        assert left == names | {f"{name}.7.tmp" for name in names}


def test_rows_of_regions_are_apart(tmp_path):
    for name in (BODY, LONGER, BODY):
        update_status(tmp_path, [{**identity(name), "decision": "use"}])
    assert [row["region"] for row in read_status(tmp_path)] == ["body", "extended"]
    earlier = {key: value for key, value in identity(BODY).items() if key != "region"}
    update_status(tmp_path, [{**earlier, "decision": "failed"}])
    assert [row["decision"] for row in read_status(tmp_path)] == ["failed", "use"]


def test_regions_share_settings(tmp_path):
    longer = Settings(body=BodySettings(region="extended"))
    assert dataset.settle_settings(tmp_path, Settings()) == dataset.settle_settings(
        tmp_path, longer
    )
    written = files.read_json(tmp_path / DATASET_FILES["settings"])["settings"]
    assert "region" not in written["body"]
    other = Settings(body=BodySettings(region="extended", min_length=3.0))
    with pytest.raises(SettingsError, match=r"body\.min_length was 5\.0, now 3\.0\)"):
        dataset.settle_settings(tmp_path, other)
