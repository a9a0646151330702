import numpy as np
import pytest

from hipsta_bids.errors import ProtocolError
from hipsta_bids.protocols.load import load_protocol, protocol_names, protocol_table
from hipsta_bids.protocols.protocol import MEDIAL_TO_LATERAL, Part, Tissue, translate

#: The codes that the protocols' authors publish, by tissue and part (the user's list).
PUBLISHED = {
    "freesurfer": {
        (233, Tissue.PRESUBICULUM, Part.HEAD),
        (234, Tissue.PRESUBICULUM, Part.BODY),
        (235, Tissue.SUBICULUM, Part.HEAD),
        (236, Tissue.SUBICULUM, Part.BODY),
        (237, Tissue.CA1, Part.HEAD),
        (238, Tissue.CA1, Part.BODY),
        (239, Tissue.CA2_3, Part.HEAD),
        (240, Tissue.CA2_3, Part.BODY),
        (241, Tissue.CA4, Part.HEAD),
        (242, Tissue.CA4, Part.BODY),
        (243, Tissue.DENTATE_GYRUS, Part.HEAD),
        (244, Tissue.DENTATE_GYRUS, Part.BODY),
        (245, Tissue.MOLECULAR_LAYER, Part.HEAD),
        (246, Tissue.MOLECULAR_LAYER, Part.BODY),
        (226, Tissue.HIPPOCAMPUS, Part.TAIL),
        (211, Tissue.HATA, Part.HEAD),
        (203, Tissue.PARASUBICULUM, Part.HEAD),
        (212, Tissue.FIMBRIA, Part.BODY),
        (215, Tissue.FISSURE, Part.UNKNOWN),
        (7001, Tissue.OTHER, Part.UNKNOWN),
    },
    "freesurferFS60": {
        (204, Tissue.PRESUBICULUM, Part.UNKNOWN),
        (205, Tissue.SUBICULUM, Part.UNKNOWN),
        (206, Tissue.CA1, Part.UNKNOWN),
        (208, Tissue.CA2_3, Part.UNKNOWN),
        (209, Tissue.CA4, Part.UNKNOWN),
        (210, Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        (214, Tissue.MOLECULAR_LAYER, Part.UNKNOWN),
        (226, Tissue.HIPPOCAMPUS, Part.TAIL),
    },
    "freesurferCA": {
        (204, Tissue.PRESUBICULUM, Part.UNKNOWN),
        (205, Tissue.SUBICULUM, Part.UNKNOWN),
        (206, Tissue.CA1, Part.UNKNOWN),
        (208, Tissue.CA2_3, Part.UNKNOWN),
        (209, Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        (226, Tissue.HIPPOCAMPUS, Part.TAIL),
    },
    "freesurferHBT": {
        (231, Tissue.HIPPOCAMPUS, Part.BODY),
        (232, Tissue.HIPPOCAMPUS, Part.HEAD),
        (226, Tissue.HIPPOCAMPUS, Part.TAIL),
    },
    "ashsABC3T": {
        (1, Tissue.CA1, Part.UNKNOWN),
        (2, Tissue.CA2, Part.UNKNOWN),
        (3, Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        (4, Tissue.CA3, Part.UNKNOWN),
        (5, Tissue.HIPPOCAMPUS, Part.TAIL),
        (8, Tissue.SUBICULUM, Part.UNKNOWN),
        (9, Tissue.ENTORHINAL, Part.UNKNOWN),
        (10, Tissue.BA35, Part.UNKNOWN),
        (11, Tissue.BA36, Part.UNKNOWN),
        (12, Tissue.PARAHIPPOCAMPAL, Part.UNKNOWN),
        (20, Tissue.HIPPOCAMPUS, Part.HEAD),
    },
    "ashsPMC": {
        (1, Tissue.CA1, Part.UNKNOWN),
        (2, Tissue.CA2, Part.UNKNOWN),
        (3, Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        (4, Tissue.CA3, Part.UNKNOWN),
        (8, Tissue.SUBICULUM, Part.UNKNOWN),
        (10, Tissue.ENTORHINAL, Part.UNKNOWN),
        (11, Tissue.BA35, Part.UNKNOWN),
        (12, Tissue.BA36, Part.UNKNOWN),
        (13, Tissue.PARAHIPPOCAMPAL, Part.UNKNOWN),
    },
    "ashsUtrecht7T": {
        (1, Tissue.ENTORHINAL, Part.UNKNOWN),
        (2, Tissue.SUBICULUM, Part.UNKNOWN),
        (3, Tissue.CA1, Part.UNKNOWN),
        (4, Tissue.CA2, Part.UNKNOWN),
        (5, Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        (6, Tissue.CA3, Part.UNKNOWN),
        (7, Tissue.CYST, Part.UNKNOWN),
        (8, Tissue.HIPPOCAMPUS, Part.TAIL),
    },
    "ashsMagdeburg7T": {
        (1, Tissue.CA1, Part.UNKNOWN),
        (2, Tissue.CA2, Part.UNKNOWN),
        (3, Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        (4, Tissue.CA3, Part.UNKNOWN),
        (5, Tissue.HIPPOCAMPUS, Part.TAIL),
        (8, Tissue.SUBICULUM, Part.UNKNOWN),
        (9, Tissue.ENTORHINAL, Part.UNKNOWN),
        (13, Tissue.CYST, Part.UNKNOWN),
    },
    "ashsT1": {
        (1, Tissue.HIPPOCAMPUS, Part.HEAD),
        (2, Tissue.HIPPOCAMPUS, Part.UNKNOWN),
        (10, Tissue.ENTORHINAL, Part.UNKNOWN),
        (11, Tissue.BA35, Part.UNKNOWN),
        (12, Tissue.BA36, Part.UNKNOWN),
        (13, Tissue.PARAHIPPOCAMPAL, Part.UNKNOWN),
    },
    "cobralab": {
        (1, Tissue.CA1, Part.UNKNOWN),
        (2, Tissue.SUBICULUM, Part.UNKNOWN),
        (4, Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        (5, Tissue.CA2_3, Part.UNKNOWN),
        (6, Tissue.MOLECULAR_LAYER, Part.UNKNOWN),
    },
    "hsf": {
        (1, Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        (2, Tissue.CA1, Part.UNKNOWN),
        (3, Tissue.CA2, Part.UNKNOWN),
        (4, Tissue.CA3, Part.UNKNOWN),
        (5, Tissue.SUBICULUM, Part.UNKNOWN),
    },
    "hsfCA23": {
        (1, Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        (2, Tissue.CA1, Part.UNKNOWN),
        (3, Tissue.CA2_3, Part.UNKNOWN),
        (4, Tissue.SUBICULUM, Part.UNKNOWN),
    },
    # Subiculum; per field: lacunosum-moleculare, radiatum, pyramidale, oriens; CA4; dentate gyrus.
    "nextbrain": {
        (code, tissue, Part.UNKNOWN)
        for tissue, codes in {
            Tissue.SUBICULUM: (326, 347, 576),
            Tissue.CA1: (341, 342, 345, 346, 564, 565),
            Tissue.CA2: (370, 371, 410, 411, 568, 569),
            Tissue.CA3: (374, 375, 420, 421, 573, 574),
            Tissue.CA4: (422, 432, 575),
            Tissue.DENTATE_GYRUS: (364, 365, 367, 404, 405, 407, 558, 559, 561),
            Tissue.MOLECULAR_LAYER: (
                *(339, 340, 343, 344, 562, 563),
                *(368, 369, 408, 409, 566, 567),
                *(372, 373, 418, 419, 571, 572),
            ),
            Tissue.FIMBRIA: (461,),
        }.items()
        for code in codes
    },
    "hippunfold": {
        (1, Tissue.SUBICULUM, Part.UNKNOWN),
        (2, Tissue.CA1, Part.UNKNOWN),
        (3, Tissue.CA2, Part.UNKNOWN),
        (4, Tissue.CA3, Part.UNKNOWN),
        (5, Tissue.CA4, Part.UNKNOWN),
        (6, Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        (7, Tissue.MOLECULAR_LAYER, Part.UNKNOWN),
        (8, Tissue.CYST, Part.UNKNOWN),
    },
}

MINIMAL = """
name = "mine"
title = "Mine"
citation = "None"
sheet = ["subiculum", "CA1"]
layer = []
interior = ["dentate_gyrus"]
labels = [
  { code = 1, tissue = "subiculum", name = "s", abbreviation = "S", color = "#000001" },
  { code = 2, tissue = "CA1", part = "body", name = "c", abbreviation = "C", color = "#0000AA" },
  { code = 3, tissue = "dentate_gyrus", name = "d", abbreviation = "D", color = "#000003" },
]
"""


def write(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", protocol_names())
def test_every_bundled_protocol_loads_with_its_published_codes(name):
    protocol = load_protocol(name)
    found = {(label.code, label.tissue, label.part) for label in protocol.labels}
    assert protocol.name == name
    assert found >= PUBLISHED[name]
    assert protocol.citation
    assert protocol.sheet == tuple(
        tissue for tissue in MEDIAL_TO_LATERAL if tissue in protocol.sheet
    )


def test_all_published_protocols_are_bundled():
    assert set(protocol_names()) == set(PUBLISHED)
    assert [row["name"] for row in protocol_table()] == list(protocol_names())
    assert all(row["title"] and int(row["labels"]) for row in protocol_table())


def test_freesurfer_lists_every_amygdala_nucleus():
    others = {lb.code for lb in load_protocol("freesurfer").labels if lb.tissue is Tissue.OTHER}
    assert others == set(range(7001, 7021))


def test_a_users_file_loads_and_fills_in_defaults(tmp_path):
    protocol = load_protocol(write(tmp_path, MINIMAL))
    assert (protocol.unlisted, protocol.right_offset, protocol.tool) == ("error", 0, "")
    assert [label.part for label in protocol.labels] == [Part.UNKNOWN, Part.BODY, Part.UNKNOWN]
    assert protocol.labels[1].color == "#0000aa"
    assert load_protocol(str(tmp_path / "mine.toml")) == protocol


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('title = "Mine"', 'titel = "Mine"', r"unknown key titel \(did you mean 'title'\?\)"),
        ('title = "Mine"', "", "key title is missing"),
        ('title = "Mine"', "title = 3", "title is 3, but has to be a text"),
        ('name = "mine"', 'name = "my-own"', "letters and digits"),
        ("code = 2", "code = 1", "code 1 is listed twice"),
        ("code = 2", "code = true", "entry 2 of labels: code is True, .* a whole number"),
        ("code = 2", "code = 0", "code is 0, but has to be above 0"),
        ("code = 2", "kode = 2", r"entry 2 of labels: unknown key kode \(did you mean 'code'\?\)"),
        ('tissue = "CA1"', 'tissue = "CA9"', r"'CA9', .* name of a tissue \(did you mean 'ca"),
        ('part = "body"', 'part = "bodi"', r"'bodi', .* of a part \(did you mean 'body'\?\)"),
        (
            'color = "#0000AA"',
            'color = "blue"',
            "color is 'blue', .* of the form #rrggbb",
        ),
        ('sheet = ["subiculum", "CA1"]', 'sheet = ["CA1", "subiculum"]', "medial to lateral"),
        ('sheet = ["subiculum", "CA1"]', 'sheet = ["CA1", "CA3"]', "no label has tissue CA3"),
        ('sheet = ["subiculum", "CA1"]', 'sheet = ["dentate_gyrus"]', "medial to lateral"),
        ('sheet = ["subiculum", "CA1"]', "sheet = []", "given without a sheet"),
        ("layer = []", 'layer = ["CA1"]', "in both sheet and layer"),
        ('interior = ["dentate_gyrus"]', 'interior = ["CA1"]', "in both sheet and interior"),
        ("layer = []", 'layer = []\nunlisted = "ignore"', "'error' or 'other'"),
        ("layer = []", "layer = []\nright_offset = 2", "exceed every code"),
        ("layer = []", "layer = []\nleft_offset = 3", "left_offset has to exceed every code"),
        ("layer = []", "layer = []\nleft_offset = 9\nright_offset = 9", "only one of left_offset"),
        ("labels = [", "labels = [ 7,", "entry 1 of labels is 7, but has to be a table"),
    ],
)
def test_a_mistake_in_a_file_is_named(tmp_path, old, new, message):
    assert old in MINIMAL
    path = write(tmp_path, MINIMAL.replace(old, new))
    with pytest.raises(ProtocolError, match=message) as caught:
        load_protocol(path)
    assert str(path) in str(caught.value)


def test_a_file_with_neither_sheet_nor_parts_is_refused(tmp_path):
    text = MINIMAL.replace('["subiculum", "CA1"]', "[]").replace('["dentate_gyrus"]', "[]")
    with pytest.raises(ProtocolError, match="neither a sheet nor a label with a part"):
        load_protocol(write(tmp_path, text.replace('part = "body", ', "")))


def test_a_file_that_is_missing_or_not_toml(tmp_path):
    with pytest.raises(ProtocolError, match="cannot read the protocol"):
        load_protocol(tmp_path / "absent.toml")
    with pytest.raises(ProtocolError, match="not a TOML file"):
        load_protocol(write(tmp_path, "name = "))


def test_an_unknown_name_suggests_the_nearest():
    with pytest.raises(ProtocolError, match="did you mean 'hippunfold'"):
        load_protocol("hipunfold")


def test_translate_follows_the_table():
    codes = np.array([[[0, 236, 237], [245, 226, 7003]]], dtype=">i4")
    tissue, part = translate(codes, load_protocol("freesurfer"))
    assert tissue.dtype == part.dtype == np.uint8
    assert tissue.tolist() == [
        [
            [Tissue.BACKGROUND, Tissue.SUBICULUM, Tissue.CA1],
            [Tissue.MOLECULAR_LAYER, Tissue.HIPPOCAMPUS, Tissue.OTHER],
        ]
    ]
    assert part.tolist() == [[[0, Part.BODY, Part.HEAD], [Part.HEAD, Part.TAIL, 0]]]


def test_translate_takes_unlisted_codes_as_the_protocol_says():
    freesurfer = load_protocol("freesurfer")  # unlisted = "other"
    tissue, _ = translate(np.array([238, 219, 90000, -1]), freesurfer)
    assert tissue.tolist() == [Tissue.CA1, Tissue.OTHER, Tissue.OTHER, Tissue.OTHER]
    with pytest.raises(
        ProtocolError, match=r"labels -4, 9, 300 are not in the protocol hippunfold"
    ) as e:
        translate(np.array([1, 2, 9, 300, -4, 9]), load_protocol("hippunfold"))
    assert e.value.reason == "unknown-labels"


def test_translate_works_for_small_unsigned_types():
    tissue, _ = translate(np.array([1, 2, 20, 0], dtype=np.uint8), load_protocol("ashsABC3T"))
    assert tissue.tolist() == [Tissue.CA1, Tissue.CA2, Tissue.HIPPOCAMPUS, Tissue.BACKGROUND]


def test_translate_refuses_labels_of_another_protocol():
    full = np.array([0, 236, 238, 240, 226])
    with pytest.raises(
        ProtocolError, match="no label of the sheet of freesurferCA occurs"
    ) as caught:
        translate(full, load_protocol("freesurferCA"))
    assert caught.value.reason == "wrong-scheme"
    with pytest.raises(ProtocolError, match="no label of a part of freesurferHBT occurs"):
        translate(np.array([0, 236]), load_protocol("freesurferHBT"))


@pytest.mark.parametrize(
    ("name", "other", "same"),
    [
        ("ashsABC3T", "ashsMagdeburg7T", True),
        ("ashsABC3T", "ashsPMC", False),  # code 10
        ("hsf", "hsfCA23", False),
        ("hippunfold", "hsf", False),
    ],
)
def test_protocols_with_the_same_body(name, other, same):
    first, second = load_protocol(name), load_protocol(other)
    assert first.same_body(second) is second.same_body(first) is same
    assert first.same_body(first)


def test_hemispheres_of_one_file_are_told_apart_by_an_offset():
    protocols = {name: load_protocol(name) for name in ("ashsPMC", "cobralab", "hsf")}
    shifts = {name: (p.shift("L"), p.shift("R"), p.offset) for name, p in protocols.items()}
    assert shifts == {"ashsPMC": (0, 100, 100), "cobralab": (100, 0, 100), "hsf": (0, 0, 0)}


def test_a_long_list_of_unknown_labels_is_cut():
    with pytest.raises(ProtocolError, match=r"109, 110, 111 and 38 more are not") as caught:
        translate(np.arange(100, 150), load_protocol("hippunfold"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("values", "fitting"),
    [
        ({1, 2, 3, 4, 5, 8, 20}, {"ashsABC3T"}),
        ({1, 2, 3, 4, 5, 8}, {"ashsABC3T", "hippunfold"}),
        ({1, 2, 3, 4, 5, 8, 9, 10, 11, 12}, {"ashsABC3T", "ashsMagdeburg7T"}),
        ({1, 2, 3, 4, 5, 8, 9, 10, 11, 12, 13}, {"ashsMagdeburg7T"}),
        ({1, 2, 3, 4, 8}, {"ashsABC3T", "ashsPMC"}),
        ({1, 2, 3, 4, 8, 10, 11, 12}, {"ashsABC3T", "ashsPMC"}),
        ({1, 2, 3, 4, 8, 10, 11, 12, 13}, {"ashsPMC"}),
        ({1, 2, 4, 10, 11, 12, 13}, set()),
        ({1, 2, 4, 5, 6}, {"cobralab"}),
        ({1, 2, 3, 4, 5}, {"hippunfold", "hsf"}),
        ({1, 2, 3, 4}, {"hsfCA23"}),
        ({341, 347, 370, 374, 365}, {"nextbrain"}),
        ({1, 2, 3, 4, 5, 6, 7, 8}, {"ashsUtrecht7T", "hippunfold"}),
        ({205, 206, 208, 204, 209}, {"freesurferCA", "freesurferFS60"}),
        ({1, 2}, set()),
        (set(), set()),
    ],
)
def test_fits_tells_protocols_by_their_values(values, fitting):
    assert {n for n in protocol_names() if load_protocol(n).fits(frozenset(values))} == fitting
