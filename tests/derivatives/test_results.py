"""Tables of sheets, read by themselves and many at once."""

import numpy as np
import pytest

from hipsta_bids.derivatives.results import read_alike, read_sheet
from hipsta_bids.errors import InputError

SHAPE = 2, 3
HEADER = "x\ty\tthickness\tsubfield\n"


def write(path, values, names=("CA1",) * 6, header=HEADER):
    rows = ((i + 1, j + 1) for i in range(SHAPE[0]) for j in range(SHAPE[1]))
    lines = [f"{x}\t{y}\t{v}\t{n}\n" for (x, y), v, n in zip(rows, values, names, strict=True)]
    path.write_text(header + "".join(lines))
    return path


def test_many_tables_have_the_values_of_each(tmp_path):
    columns = ["1.5", "n/a", "2", "0.25", "3", "7"], list("654321"), ["n/a"] * 6
    names = ("CA1", "CA1", "n/a", "Sub", "CA1", "CA2"), ("Sub",) * 6, ("n/a",) * 6
    paths = [
        write(tmp_path / f"{n}.tsv", *row) for n, row in enumerate(zip(columns, names, strict=True))
    ]
    tables = read_alike(paths, ["thickness"], ["subfield"], SHAPE)
    for n, path in enumerate(paths):
        single = read_sheet(path, ["thickness"], ["subfield"], SHAPE)
        np.testing.assert_array_equal(tables["thickness"][n], single["thickness"])
        assert tables["subfield"][n].tolist() == single["subfield"].tolist()
    assert tables["thickness"][0].tolist()[1] == [0.25, 3, 7]
    assert tables["subfield"][0].tolist()[0] == ["CA1", "CA1", ""]


def test_of_many_tables_a_damaged_one_is_named_and_other_columns_are_read(tmp_path):
    paths = [write(tmp_path / f"{n}.tsv", "123456") for n in range(3)]
    paths[2].write_text(paths[2].read_text().replace("\n", "\tmore\n"))
    assert read_alike(paths, ["thickness"], [], SHAPE)["thickness"].shape == (3, *SHAPE)
    # Rows that one lacks and another has too many are no two sheets.
    lines = paths[0].read_text().splitlines(keepends=True)
    paths[0].write_text("".join(lines[:-1]))
    paths[1].write_text("".join([*lines, lines[-1]]))
    with pytest.raises(InputError, match=r"0\.tsv: not a sheet of 2 x 3 nodes"):
        read_alike(paths, ["thickness"], [], SHAPE)
    with pytest.raises(InputError, match=r"none\.tsv: not readable as a sheet"):
        read_alike([paths[2], tmp_path / "none.tsv"], ["thickness"], [], SHAPE)
