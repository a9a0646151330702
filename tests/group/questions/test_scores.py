"""Models of scores: the model of the reference group, without the groups."""

from hipsta_bids.group.questions.scores import without_variable


def test_names_with_blanks_keep_their_backticks():
    assert without_variable("`age at scan`*`lambda` + group", "group") == (
        "1 + `age at scan` + `lambda` + `age at scan`:`lambda`"
    )
