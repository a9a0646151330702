"""Images of docs/ are made by scripts, which record the version that made them."""

import figure_record
from figure_record import ROOT, SCRIPTS, drawn, hash_of, read, store

from hipsta_bids import __version__

DOCS = ROOT / "docs"
IMAGES = [
    *(path for path in (DOCS / "images").iterdir() if path.suffix in {".png", ".svg"}),
    *(DOCS / "figures").rglob("*.png"),
]


def test_each_image_is_drawn_by_one_script():
    every = [path for name in SCRIPTS for path in drawn(name)]
    assert len(every) == len(set(every))
    assert set(IMAGES) <= set(every)
    for name, script in SCRIPTS.items():
        assert (ROOT / "tools" / f"{name}.py").is_file()
        assert all(any(DOCS.glob(pattern)) for pattern in script.patterns)


def test_a_script_records_its_images_and_leaves_those_of_others(tmp_path, monkeypatch):
    monkeypatch.setattr(figure_record, "RECORD", tmp_path / "record.json")
    monkeypatch.setattr(figure_record, "package", lambda: "0123")
    store("pet_figure")
    store("readme_figure")
    assert list(read()) == ["images/pet-fmri.png", "images/readme.png"]
    entry = read()["images/readme.png"]
    assert (entry["script"], entry["version"], entry["code"]) == (
        *("readme_figure", __version__, "0123"),
    )
    assert entry["file"] == hash_of(DOCS / "images/readme.png")
