"""Provenance files follow BIDS' proposal: identifiers resolve, and no path or user is in them."""

import hashlib
import json
import re

import pytest

import hipsta_bids as hb
from hipsta_bids.cli.main import main
from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.results import list_results, read_record

SUFFIXES = {"act": "Activities", "ent": "ProvEntities", "soft": "Software"}


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    assert main(["demo-data", str(folder / "bids")]) == 0
    line = [str(folder / "bids"), str(folder / "out"), "participant", "--n-procs", "1"]
    assert main([*line, "--participant-label", "demo1"]) == 0
    return folder / "out"


@pytest.fixture(scope="module")
def folder(out, tmp_path_factory):
    folder = tmp_path_factory.mktemp("prov")
    assert main(["export", str(out), str(folder), "--format", "prov"]) == 0
    return folder


@pytest.fixture(scope="module")
def objects(folder):
    found = {}
    for suffix, key in SUFFIXES.items():
        text = (folder / "prov" / f"prov-hipstabids_{suffix}.json").read_text(encoding="utf-8")
        (name, found[suffix]) = next(iter(json.loads(text).items()))
        assert name == key
    return found


def test_each_hemisphere_is_an_activity_that_used_its_inputs(out, objects):
    places = list_results(out)
    by_label = {one["Label"].removeprefix("Measurement of "): one for one in objects["act"]}
    assert set(by_label) == {place.name.title for place in places}
    for place in places:
        activity = by_label[place.name.title]
        inputs = [entry["file"] for entry in read_record(place)["inputs"]]
        assert activity["Used"] == [*inputs, "bids::desc-settings.json"]
        sheet = f"bids::{place.path('sheet').relative_to(out).as_posix()}"
        (made,) = [one for one in objects["ent"] if one["Id"] == sheet]
        assert made["GeneratedBy"] == activity["Id"]


def test_identifiers_are_unique_and_resolve(out, objects):
    identifiers = [one["Id"] for part in objects.values() for one in part]
    assert len(identifiers) == len(set(identifiers))
    own = re.compile(r"bids::prov#[\w]+-[0-9a-f]{8}")
    assert all(own.fullmatch(one["Id"]) for key in ("act", "soft") for one in objects[key])
    known = {*identifiers, "bids::desc-settings.json"}
    links = dataset.read_links(out)
    for activity in objects["act"]:
        assert {*activity["Used"], activity["AssociatedWith"]} <= known
    for entity in objects["ent"]:
        name, path = re.fullmatch(r"bids:([^:]*):(.+)", entity["Id"]).groups()
        root = out if not name else dataset.linked_folder(links[name], out)
        assert (root / path).is_file()
        if "Digest" in entity:
            digest = hashlib.sha256((root / path).read_bytes()).hexdigest()
            assert entity["Digest"] == {"sha256": digest}
    assert sum("Digest" in one for one in objects["ent"]) > 0
    (maker,) = objects["soft"]
    assert (maker["Label"], maker["Version"]) == ("hipsta_bids", hb.__version__)


def test_neither_paths_nor_users_are_told_and_repeats_are_equal(out, folder, tmp_path):
    text = "".join(path.read_text() for path in sorted((folder / "prov").iterdir()))
    assert str(out) not in text
    assert not re.search(r'["\s]/', text)  # an absolute path, which may have a user's name
    assert main(["export", str(out), str(tmp_path), "--format", "prov"]) == 0
    again = "".join(path.read_text() for path in sorted((tmp_path / "prov").iterdir()))
    assert text == again


def test_a_folder_without_results_is_refused(tmp_path, capsys):
    assert main(["export", str(tmp_path), str(tmp_path / "x"), "--format", "prov"]) == 66
    assert "no measured hemisphere" in capsys.readouterr().err
