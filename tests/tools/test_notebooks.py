"""Notebooks of docs/: pages from stored outputs, and whether these are what the cells give."""

import ast
import base64
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from notebooks import check, notebook_page, run_notebook, store, texts_of

TOOL = Path(__file__).parents[2] / "tools" / "notebooks.py"
NOTEBOOKS = sorted((Path(__file__).parents[2] / "docs" / "notebooks").glob("*.ipynb"))


def notebook(*sources):
    cells = [
        {"cell_type": "code", "execution_count": None, "id": f"cell-{i}", "metadata": {},
         "outputs": [], "source": source.splitlines(keepends=True)}
        for i, source in enumerate(sources)
    ]  # fmt: skip
    return {"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 5}


def test_outputs_are_stored_and_shown(tmp_path):
    path = tmp_path / "some.ipynb"
    table = "import pandas\npandas.DataFrame({'a': [1.5]})"
    figure = "from matplotlib import pyplot\npyplot.plot([1, 2]);"
    store(path, notebook("print('a < b')\n1 + 1", "x = 3", table, figure))
    store(path, run_notebook(path))
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    kinds = [[output["output_type"] for output in cell["outputs"]] for cell in cells]
    assert kinds == [["stream", "execute_result"], [], ["execute_result"], ["display_data"]]
    assert [cell["execution_count"] for cell in cells] == [1, 2, 3, 4]
    assert cells[0]["outputs"][1]["data"] == {"text/plain": ["2"]}
    assert texts_of({"cells": cells})[0] == "a < b\n"
    text, figures = notebook_page(path)
    assert '<pre class="output">a &lt; b</pre>\n\n<pre class="output">2</pre>' in text
    assert "<td>1.5</td>" in text
    assert text.rstrip().endswith("(some-1.png)")
    assert figures["some-1.png"].startswith(b"\x89PNG")
    assert (
        base64.b64encode(figures["some-1.png"]).decode()
        == (cells[3]["outputs"][0]["data"]["image/png"])
    )


def test_warnings_are_errors(tmp_path):
    store(tmp_path / "bad.ipynb", notebook("1", "import warnings\nwarnings.warn('old')"))
    with pytest.raises(UserWarning, match="old") as caught:
        run_notebook(tmp_path / "bad.ipynb")
    assert caught.value.__notes__ == ["bad.ipynb, code cell 2"]


def test_stored_outputs_are_compared(tmp_path):
    path = tmp_path / "some.ipynb"
    store(path, notebook("print('a')\nprint('b')"))
    store(path, run_notebook(path))
    check(path)
    path.write_text(path.read_text(encoding="utf-8").replace('"b\\n"', '"c\\n"'), encoding="utf-8")
    with pytest.raises(SystemExit, match=r"some\.ipynb: other outputs are stored(.|\n)*-c\n\+b"):
        check(path)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_of_the_package_only_hb_is_imported(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "code")
    found = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Import)]
    assert [ast.unparse(node) for node in found] == ["import hipsta_bids as hb"]
    # nilearn is shown to take our maps.
    origins = [
        node.module for node in ast.walk(ast.parse(code)) if isinstance(node, ast.ImportFrom)
    ]
    assert all(origin.startswith("nilearn.") for origin in origins)


@pytest.mark.skipif(
    os.environ.get("HIPSTA_BIDS_TUTORIALS") != "required", reason="run tools/test-tutorials"
)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_outputs_are_what_cells_give(path):
    command = [sys.executable, TOOL, "--check", path]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
