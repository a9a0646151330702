import json
import multiprocessing
import re
from email.message import Message
from pathlib import Path

import pytest
from stand_ins import make_scheme

from hipsta_bids import __version__
from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.dataset import COLUMNS, read_status, update_status, write_sidecar
from hipsta_bids.derivatives.names import DATASET_FILES
from hipsta_bids.errors import InputError, SettingsError, UsageError
from hipsta_bids.io import files
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import BodySettings, Settings


def description(root):
    return json.loads((root / "dataset_description.json").read_text())


def test_description_has_what_the_standard_asks_for(tmp_path, monkeypatch):
    monkeypatch.setenv("HIPSTA_BIDS_CONTAINER_TYPE", "docker")
    monkeypatch.setenv("HIPSTA_BIDS_CONTAINER_TAG", "lab/hipsta_bids:1")
    monkeypatch.setenv("HIPSTA_BIDS_CODE_URL", "https://example.org/code")
    monkeypatch.delenv("APPTAINER_CONTAINER", raising=False)
    monkeypatch.delenv("SINGULARITY_CONTAINER", raising=False)
    source = tmp_path / "in put"
    source.mkdir()
    (source / "dataset_description.json").write_text('{"DatasetDOI": "doi:10.1/x"}')
    dataset.write_description(tmp_path / "out", {"freesurfer": source})
    written = description(tmp_path / "out")
    assert written["DatasetType"] == "derivative"
    assert written["Name"]
    assert written["BIDSVersion"]
    (maker,) = written["GeneratedBy"]
    assert maker["Name"] == "hipsta_bids"
    assert maker["Version"] == __version__
    assert maker["Container"] == {"Type": "docker", "Tag": "lab/hipsta_bids:1"}
    assert maker["CodeURL"] == "https://example.org/code"
    assert written["SourceDatasets"] == [{"URL": "../in%20put", "DOI": "doi:10.1/x"}]
    assert written["DatasetLinks"] == {"freesurfer": "../in%20put"}
    assert "*_label-*" in (tmp_path / "out" / ".bidsignore").read_text().splitlines()
    assert "DatasetLinks" in (tmp_path / "out" / "README.md").read_text()


def test_description_keeps_earlier_sources_and_needs_no_container(tmp_path, monkeypatch):
    for variable in (*dataset.CONTAINER_VARIABLES.values(), *dataset._APPTAINER_VARIABLES):
        monkeypatch.delenv(variable, raising=False)
    for name in ("b", "a", "a"):
        dataset.write_description(tmp_path / "out", {name: tmp_path / name})
    urls = [entry["URL"] for entry in description(tmp_path / "out")["SourceDatasets"]]
    assert urls == ["../a", "../b"]
    assert "Container" not in description(tmp_path / "out")["GeneratedBy"][0]


@pytest.mark.parametrize("damage", [None, "x", 7, ["x", {"URL": 3}, {}], {"a": []}])
def test_a_damaged_description_is_written_anew(tmp_path, damage):
    dataset.write_description(tmp_path, {"a": tmp_path / "a"})
    content = description(tmp_path) | {"SourceDatasets": damage, "DatasetLinks": damage}
    files.write_json(tmp_path / "dataset_description.json", content)
    dataset.write_description(tmp_path, {"b": tmp_path / "b"})
    assert {"URL": "b"} in description(tmp_path)["SourceDatasets"]
    assert description(tmp_path)["DatasetLinks"]["b"] == "b"


@pytest.mark.parametrize("damage", [None, "x", [1]])
def test_damaged_settings_are_other_settings(tmp_path, damage):
    files.write_json(tmp_path / "desc-settings.json", {"hash": "0", "settings": damage})
    with pytest.raises(SettingsError, match="results with other settings"):
        dataset.settle_settings(tmp_path, Settings())


def test_settings_that_are_gone_are_those_of_another_version(tmp_path):
    earlier = {"hash": "0", "version": "0.0.9", "settings": {"body": {"plane_tilt": 10.0}}}
    files.write_json(tmp_path / "desc-settings.json", earlier)
    gone = r"version 0\.0\.9, .* 1 other settings \(body\.plane_tilt.*new output folder"
    with pytest.raises(SettingsError, match=gone):
        dataset.settle_settings(tmp_path, Settings())


def test_a_new_version_may_add_settings(tmp_path):
    path = tmp_path / "desc-settings.json"
    digest = dataset.settle_settings(tmp_path, Settings())
    current = files.read_json(path)
    assert not dataset.upgrade_notes(tmp_path)
    earlier = json.loads(json.dumps(current)) | {"hash": "0", "version": "0.0.9"}
    del earlier["settings"]["grid"]
    files.write_json(path, earlier)
    (note,) = dataset.upgrade_notes(tmp_path)
    again = "measures all hemispheres again, with the same settings only"
    assert note.endswith(f"results of version 0.0.9; {__version__} {again}")
    assert dataset.settle_settings(tmp_path, Settings()) == digest
    assert files.read_json(path) == current
    files.write_json(path, earlier)
    with pytest.raises(SettingsError, match=r"body\.end_rule was"):
        dataset.settle_settings(tmp_path, Settings().changed(body={"end_rule": "last-slice"}))
    files.write_json(path, earlier | {"version": current["version"]})  # not by this version
    with pytest.raises(SettingsError, match=r"grid\.spacing was not there"):
        dataset.settle_settings(tmp_path, Settings())


def test_apptainer_and_the_address_in_the_package_are_named(tmp_path, monkeypatch):
    monkeypatch.setenv("HIPSTA_BIDS_CONTAINER_TYPE", "docker")  # of the image it was made from
    monkeypatch.setenv("APPTAINER_CONTAINER", "/images/hipsta_bids.sif")
    monkeypatch.delenv("HIPSTA_BIDS_CODE_URL", raising=False)
    about = Message()
    about["Project-URL"] = "Documentation, https://example.org/docs"
    monkeypatch.setattr(dataset, "metadata", lambda _: about)
    dataset.write_description(tmp_path, {})
    (maker,) = description(tmp_path)["GeneratedBy"]
    assert maker["Container"]["Type"] == "apptainer"
    assert "CodeURL" not in maker
    about["Project-URL"] = "Source, https://example.org/code"
    dataset.write_description(tmp_path, {})
    assert description(tmp_path)["GeneratedBy"][0]["CodeURL"] == "https://example.org/code"


def test_links_lead_back_also_when_both_folders_move(tmp_path):
    study = tmp_path / "study"
    source, root = study / "derivatives" / "free surfer: 100%", study / "derivatives" / "out"
    source.mkdir(parents=True)
    dataset.write_description(root, {"fs": source})
    (tmp_path / "elsewhere").mkdir()
    moved = study.rename(tmp_path / "elsewhere" / "study") / "derivatives"
    links = dataset.read_links(moved / "out")
    assert not links["fs"].startswith(("/", "file:"))
    path = dataset.linked_path("bids:fs:sub-01/mri/x.mgz", moved / "out", links)
    assert path.resolve() == moved / source.name / "sub-01/mri/x.mgz"
    assert dataset.linked_path("bids:other:x", moved / "out", links) is None
    assert dataset.linked_path("/a/b.mgz", moved, links) == Path("/a/b.mgz")
    assert dataset.linked_path("", moved, links) is None
    assert dataset.linked_path("bids:far:x", moved, {"far": "doi:10.18112/ds000001"}) is None


def test_links_are_spelled_as_the_user_did(tmp_path):
    """The same with symbolic links: relative where that leads there, absolute across the root."""
    disk, study = tmp_path / "disk", tmp_path / "study"
    (disk / "fs").mkdir(parents=True)
    (disk / "results").mkdir()
    study.mkdir()
    (study / "fs").symlink_to(disk / "fs")
    (study / "out").symlink_to(disk / "results")
    assert dataset.link_to(study / "fs", study) == "fs"
    assert dataset.link_to(study / "fs", study / "plain") == "../fs"
    # From behind a link, two dots lead to where the folder really is.
    link = dataset.link_to(study / "fs", study / "out")
    assert dataset.linked_folder(link, study / "out").resolve() == disk / "fs"
    assert dataset.link_to(Path("/data/x"), Path("/out")) == "file:///data/x"
    assert dataset.linked_folder("file:///data/x", Path("/out")) == Path("/data/x")


def test_links_of_earlier_versions_are_read_and_replaced(tmp_path):
    source, root = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    root.mkdir()
    uri, other = source.as_uri(), "file:///other/machine"
    content = {
        "GeneratedBy": [{"Name": "hipsta_bids"}],
        "SourceDatasets": [{"URL": uri}, {"URL": other}],
        "DatasetLinks": {"fs": uri, "far": other},
    }
    (root / "dataset_description.json").write_text(json.dumps(content))
    links = dataset.read_links(root)
    assert dataset.linked_path("bids:fs:a.mgz", root, links) == source / "a.mgz"
    dataset.write_description(root, {"fs": source})
    assert description(root)["DatasetLinks"] == {"far": other, "fs": "../in"}
    assert description(root)["SourceDatasets"] == [{"URL": "../in"}, {"URL": other}]


def test_a_readme_of_the_user_stays(tmp_path):
    (tmp_path / "README").write_text("mine")
    dataset.write_notes(tmp_path)
    assert [path.name for path in tmp_path.glob("README*")] == ["README"]
    assert (tmp_path / "README").read_text() == "mine"


def test_dataset_of_other_software_is_refused(tmp_path):
    dataset.check_own_dataset(tmp_path)
    path = tmp_path / "dataset_description.json"
    path.write_text('{"GeneratedBy": [{"Name": "fMRIPrep"}]}')
    with pytest.raises(UsageError, match="fMRIPrep"):
        dataset.check_own_dataset(tmp_path)
    path.write_text("{}")
    with pytest.raises(UsageError, match="another kind"):
        dataset.check_own_dataset(tmp_path)
    dataset.write_description(tmp_path / "ours", {})
    dataset.check_own_dataset(tmp_path / "ours")


def test_other_settings_are_refused_by_name(tmp_path):
    digest = dataset.settle_settings(tmp_path, Settings())
    assert dataset.settle_settings(tmp_path, Settings()) == digest
    other = Settings(body=BodySettings(layer_rule="nearest-label"))
    with pytest.raises(
        SettingsError, match=r"body\.layer_rule was nearest-sheet, now nearest-label"
    ) as caught:
        dataset.settle_settings(tmp_path, other)
    assert "new output folder" in str(caught.value)
    assert caught.value.exit_code == 64
    (tmp_path / DATASET_FILES["settings"]).write_text("[")
    with pytest.raises(InputError, match="JSON"):
        dataset.settle_settings(tmp_path, Settings())


def test_settings_of_another_version_are_refused_by_name(tmp_path):
    class Newer(Settings):
        extra: int = 3

    dataset.settle_settings(tmp_path, Settings())
    with pytest.raises(SettingsError, match="extra was not there, now 3"):
        dataset.settle_settings(tmp_path, Newer())


def test_sources_get_distinct_names(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    names = dataset.source_names([("free surfer", a), ("free surfer", b), ("free surfer", a)])
    assert names == {"free-surfer": a, "free-surfer-2": b}
    assert dataset.source_address(b / "x" / "y.mgz", names) == "bids:free-surfer-2:x/y.mgz"
    assert dataset.source_address(tmp_path / "c", names) == str(tmp_path / "c")


def test_citation_states_settings_and_protocols():
    settings = Settings(body=BodySettings(layer_rule="nearest-label"))
    text = dataset.citation_text(settings, [make_scheme()])
    assert f"hipsta_bids {__version__}" in text
    assert "the dentate gyrus and CA4 included" in text
    assert "`body.layer_rule`: nearest-label" in text
    for reference in ("120182", "BrainPrint", "TetGen", "Nobody N"):
        assert reference in text
    for sign in ("{", "[@"):
        assert sign not in text


def test_citation_numbers_works_as_the_text_names_them():
    protocols = [load_protocol(name) for name in ("freesurfer", "freesurferCA", "hippunfold")]
    text = dataset.citation_text(Settings(), protocols)
    prose, _, bibliography = text.partition("# References")
    cited = [int(number) for number in re.findall(r"\[(\d+)\]", prose.split("# Settings")[0])]
    works = bibliography.split("\n")
    assert list(dict.fromkeys(cited)) == list(range(1, max(cited) + 1))
    assert sum(bool(re.match(r"\d+\. ", work)) for work in works) == max(cited)
    assert sum("Iglesias JE" in work for work in works) == 1  # of both protocols of FreeSurfer


def test_citation_names_pybids_only_where_it_was_used():
    for pybids in (True, False):
        text = dataset.citation_text(Settings(), [make_scheme()], pybids=pybids)
        assert ("selected with PyBIDS" in text) == ("10.21105/joss.01294" in text) == pybids


def test_citation_says_whose_molecular_layer_was_left_out():
    protocols = [load_protocol("freesurfer"), load_protocol("hippunfold")]
    text = dataset.citation_text(Settings(), protocols)
    assert "assigned to the nearest subfield of the sheet; with hippunfold it was excluded." in text
    joined = Settings(body=BodySettings(join_every_layer=True))
    for settings, chosen in ((joined, protocols), (Settings(), protocols[:1])):
        assert "excluded" not in dataset.citation_text(settings, chosen)


def row(subject, hemi="L", **more):
    identity = {"subject": subject, "session": "n/a", "hemi": hemi, "seg": "x"}
    return identity | {"decision": "use"} | more


def test_status_rows_of_other_hemispheres_stay(tmp_path):
    update_status(tmp_path, [row("sub-02", seconds_read="1.0"), row("sub-01")])
    update_status(tmp_path, [row("sub-02", decision="failed", seconds_mesh="2.0")])
    rows = read_status(tmp_path)
    assert [(r["subject"], r["decision"]) for r in rows] == [
        ("sub-01", "use"),
        ("sub-02", "failed"),
    ]
    assert list(rows[0]) == [*COLUMNS, "seconds_read", "seconds_mesh"]
    assert rows[0]["reason"] == "n/a"


def test_unreadable_status_is_rebuilt(tmp_path):
    (tmp_path / "status.tsv").write_text("a\tb\n1\n")
    update_status(tmp_path, [row("sub-01")])
    assert len(read_status(tmp_path)) == 1


def add_rows(folder, subject, started=None):
    if started:
        started.set()
    for session in range(20):
        update_status(folder, [row(subject) | {"session": f"ses-{session}"}])


def test_runs_side_by_side_lose_no_row(tmp_path):
    context = multiprocessing.get_context("spawn")
    other = context.Process(target=add_rows, args=(tmp_path, "sub-1", started := context.Event()))
    other.start()
    assert started.wait(100)
    add_rows(tmp_path, "sub-0")
    other.join()
    assert len(read_status(tmp_path)) == 40


def test_status_sidecar_defines_the_columns(tmp_path):
    write_sidecar(tmp_path)
    definitions = json.loads((tmp_path / "status.json").read_text())
    assert set(COLUMNS) < set(definitions)


def test_the_methods_text_says_which_steps_are_as_published():
    usual = dataset.citation_text(Settings(), [])
    settings = Settings().changed(
        body={"end_rule": "last-slice"}, boundaries={"operator": "published", "edges": "zero-lines"}
    )
    published = dataset.citation_text(settings, [])
    for text in ("lay at the last slices with CA1", "of the original method, without a thresh"):
        assert text in published
        assert text not in usual
    assert "moved to the middle of the sheet's edges" in usual
    assert "moved to the middle" not in published
