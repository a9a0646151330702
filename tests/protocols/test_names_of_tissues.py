import pytest

from hipsta_bids.errors import ProtocolError
from hipsta_bids.protocols.load import (
    NamedCode,
    agrees,
    identify_tissue,
    load_protocol,
    protocol_from_names,
    protocol_names,
)
from hipsta_bids.protocols.protocol import Part, Tissue


@pytest.mark.parametrize(
    ("name", "tissue", "part"),
    [
        ("CA1", Tissue.CA1, Part.UNKNOWN),
        ("Left-CA1-head", Tissue.CA1, Part.HEAD),
        ("right CA2/3 body", Tissue.CA2_3, Part.BODY),
        ("CA2_3", Tissue.CA2_3, Part.UNKNOWN),
        ("dentate_gyrus", Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        ("CA4_and_dentate gyrus", Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        ("DG (with CA4)", Tissue.DENTATE_GYRUS, Part.UNKNOWN),
        ("GC-ML-DG-body", Tissue.DENTATE_GYRUS, Part.BODY),
        ("molecular_layer_HP-head", Tissue.MOLECULAR_LAYER, Part.HEAD),
        ("SRLM", Tissue.MOLECULAR_LAYER, Part.UNKNOWN),
        ("Hippocampal_tail", Tissue.HIPPOCAMPUS, Part.TAIL),
        ("tail", Tissue.HIPPOCAMPUS, Part.TAIL),
        ("hippocampus", Tissue.HIPPOCAMPUS, Part.UNKNOWN),
        ("hippocampal fissure", Tissue.FISSURE, Part.UNKNOWN),
        ("parahippocampal cortex", Tissue.PARAHIPPOCAMPAL, Part.UNKNOWN),
        ("Clear Label", Tissue.BACKGROUND, Part.UNKNOWN),
        ("thalamus", Tissue.OTHER, Part.UNKNOWN),
        ("left", Tissue.OTHER, Part.UNKNOWN),
    ],
)
def test_names_are_understood(name, tissue, part):
    assert identify_tissue(name) == (tissue, part)


@pytest.mark.parametrize("name", protocol_names())
def test_the_names_in_bundled_protocols_are_understood(name):
    if load_protocol(name).refused or name == "nextbrain":  # parts; layers of fields
        pytest.skip("names things that are no subfields")
    # CA3 is the name that FreeSurfer gives to CA2 and CA3 together; nothing in it says so.
    for label in load_protocol(name).labels:
        if (label.name.startswith("CA3") and name.startswith("freesurfer")) or label.code > 7000:
            continue
        assert identify_tissue(label.name)[0] is label.tissue, label.name


def rows(*names):
    return [NamedCode(code=code, name=name) for code, name in enumerate(names)]


def test_a_table_makes_a_protocol():
    protocol = protocol_from_names(
        rows("Clear Label", "CA1", "subiculum", "DG", "SRLM", "amygdala"),
        name="mine",
        origin="table.tsv",
    )
    assert protocol.sheet == (Tissue.SUBICULUM, Tissue.CA1)
    assert protocol.layer == (Tissue.MOLECULAR_LAYER,)
    assert protocol.interior == (Tissue.DENTATE_GYRUS, Tissue.MOLECULAR_LAYER)
    assert protocol.codes == {1, 2, 3, 4, 5}
    assert "table.tsv" in protocol.title


def test_abbreviations_and_colors_are_used():
    table = [
        NamedCode(code=1, name="field one", abbreviation="CA1", color="#ABCDEF"),
        NamedCode(code=2, name="Subiculum", color="red"),
    ]
    first, second = protocol_from_names(table, name="mine", origin="t").labels
    assert (first.tissue, first.abbreviation, first.color) == (Tissue.CA1, "CA1", "#abcdef")
    assert second.abbreviation == "Subiculum"
    assert second.color.startswith("#")


def test_tables_without_subfields_and_with_repeated_codes_are_refused():
    with pytest.raises(ProtocolError, match="no names of subiculum and CA1") as caught:
        protocol_from_names(rows("", "thalamus", "CA1"), name="mine", origin="t")
    assert caught.value.reason == "unclear-names"
    with pytest.raises(ProtocolError, match="code 1, 2 is listed twice"):
        protocol_from_names(rows("", "CA1", "subiculum") * 2, name="mine", origin="t")


def test_agrees_compares_meanings_not_spellings():
    abc, pmc = load_protocol("ashsABC3T"), load_protocol("ashsPMC")
    names = {1: "CA1", 2: "CA2", 3: "DG", 4: "CA3", 8: "SUB"}
    common = [NamedCode(code=code, name=name) for code, name in names.items()]
    assert agrees(abc, common)
    assert agrees(pmc, common)
    with_erc = [*common, NamedCode(code=10, name="ERC")]
    assert agrees(pmc, with_erc)
    assert not agrees(abc, with_erc)
    assert not agrees(abc, common[1:])  # no CA1
