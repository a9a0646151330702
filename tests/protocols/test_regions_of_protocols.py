"""Neighboring cortex in protocols, and the sheet that each region makes of them."""

import numpy as np
import pytest

from hipsta_bids.cli.participant import REGIONS
from hipsta_bids.errors import ProtocolError
from hipsta_bids.protocols.load import (
    NamedCode,
    for_region,
    load_protocol,
    parse_protocol,
    protocol_from_names,
    protocol_names,
)
from hipsta_bids.protocols.protocol import FAR_TO_NEAR, MEDIAL_TO_LATERAL, Tissue, lateral_rank
from hipsta_bids.settings import BodySettings

CORTEX = (Tissue.BA35, Tissue.ENTORHINAL, Tissue.PARAHIPPOCAMPAL)


def table(**changes):
    """A small protocol with cortex."""
    names = ["subiculum", "CA1", "BA35", "entorhinal"]
    label = {"abbreviation": "x", "color": "#000000"}
    return {
        "name": "mine",
        "title": "Mine",
        "citation": "none",
        "sheet": ["subiculum", "CA1"],
        "layer": [],
        "interior": [],
        "neighbors": ["BA35", "entorhinal"],
        "labels": [
            {"code": code, "tissue": name, "name": name, **label}
            for code, name in enumerate(names, start=1)
        ],
    } | changes


def test_bundled_protocols_with_cortex():
    found = {name: load_protocol(name).neighbors for name in protocol_names()}
    assert {name: cortex for name, cortex in found.items() if cortex} == {
        "ashsABC3T": CORTEX,
        "ashsMagdeburg7T": (Tissue.ENTORHINAL,),
        "ashsPMC": CORTEX,
        "ashsUtrecht7T": (Tissue.ENTORHINAL,),
    }


@pytest.mark.parametrize("name", ["ashsABC3T", "ashsMagdeburg7T", "ashsPMC", "ashsUtrecht7T"])
def test_ranks_rise_along_the_sheet_of_every_region(name):
    protocol = load_protocol(name)
    assert for_region(protocol, "body") is protocol
    extended, alone = (for_region(protocol, region).sheet for region in ("extended", "entorhinal"))
    assert extended == (*protocol.neighbors, *protocol.sheet)
    assert alone == protocol.neighbors
    ranks = lateral_rank(np.array(extended, dtype=np.uint8))
    assert (np.diff(ranks) >= 0).all()
    assert (np.diff(ranks[len(alone) - 1 :]) > 0).all()


def test_ranks_of_subfields_are_their_values():
    values = np.array(MEDIAL_TO_LATERAL, dtype=np.uint8)
    assert lateral_rank(values).tolist() == values.tolist()
    assert lateral_rank(np.array(FAR_TO_NEAR, dtype=np.uint8)).max() < values.min()
    assert lateral_rank(np.zeros((2, 2), dtype=np.uint8)).tolist() == [[0, 0], [0, 0]]


def test_a_protocol_without_cortex_says_which_have():
    for region in ("extended", "entorhinal"):
        with pytest.raises(ProtocolError, match=r"ashsABC3T, .*, ashsUtrecht7T have") as caught:
            for_region(load_protocol("freesurfer"), region)
        assert caught.value.reason == "no-cortex-labels"
        assert "\n" not in str(caught.value)


def test_the_command_line_and_the_settings_know_the_same_regions():
    assert [BodySettings(region=region).region for region in REGIONS] == list(REGIONS)


@pytest.mark.parametrize(
    ("neighbors", "message"),
    [
        (["entorhinal", "BA35"], "far to near"),
        (["BA35", "BA35"], "far to near"),
        (["BA36"], "no label has tissue BA36"),
        (["subiculum"], "far to near"),
        (["entorinal"], r"entry 1 of neighbors is 'entorinal', .*\(did you mean 'entorhinal'\?\)"),
    ],
)
def test_wrong_neighbors_are_named(neighbors, message):
    assert parse_protocol(table(), origin="a").neighbors == (Tissue.BA35, Tissue.ENTORHINAL)
    with pytest.raises(ProtocolError, match=message):
        parse_protocol(table(neighbors=neighbors), origin="a")


def test_label_tables_name_their_cortex():
    names = ["SUB", "CA1", "DG", "ERC", "BA35", "BA36", "PHC"]
    rows = [NamedCode(code=code, name=name) for code, name in enumerate(names, start=1)]
    assert protocol_from_names(rows, name="x", origin="a").neighbors == CORTEX
    assert protocol_from_names(rows[:3], name="x", origin="a").neighbors == ()
