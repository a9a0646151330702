"""Runs notebooks of docs/ and stores what their cells show; writes them as pages of the site.

As in Jupyter, the value of a cell's last expression is shown, and figures that are open at its end
are drawn. A warning is an error.

.venv/bin/python tools/notebooks.py docs/notebooks/NAME.ipynb ...    runs them, stores the outputs
.venv/bin/python tools/notebooks.py --check docs/notebooks/NAME.ipynb ...    compares them instead
"""

import ast
import base64
import json
import re
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import chdir, redirect_stdout
from difflib import unified_diff
from html import escape
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import matplotlib as mpl

_DPI = 72
#: How pandas styles tables; those of the site have a style of their own.
_PANDAS = re.compile(r'<style scoped>.*?</style>| border="\d" class="dataframe"', re.DOTALL)

Output = dict[str, Any]
"""Of a cell, as nbformat 4 has it."""


def run_notebook(path: Path) -> dict[str, Any]:
    """Run all cells in a folder of their own; return the notebook with their outputs."""
    mpl.use("agg")
    notebook: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    names: dict[str, Any] = {"__name__": "__main__"}
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    with tempfile.TemporaryDirectory() as folder, chdir(folder), warnings.catch_warnings():
        warnings.simplefilter("error")
        for number, cell in enumerate(cells, start=1):
            cell["execution_count"] = number
            try:
                cell["outputs"] = [*_outputs("".join(cell["source"]), names, number), *_figures()]
            except Exception as error:
                error.add_note(f"{path.name}, code cell {number}")
                raise
    return notebook


def store(path: Path, notebook: dict[str, Any]) -> None:
    """Write a notebook as Jupyter does."""
    text = json.dumps(notebook, indent=1, ensure_ascii=False)
    path.write_text(f"{text}\n", encoding="utf-8")


def texts_of(notebook: dict[str, Any]) -> list[str]:
    """Return the text of all outputs, without pictures."""
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", ())]
    texts = [output.get("text") or output["data"].get("text/plain") for output in outputs]
    return ["".join(text) for text in texts if text]


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """Return a notebook with its stored outputs in Markdown, and figures by name."""
    parts: list[str] = []
    figures: dict[str, bytes] = {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {"text/plain": output.get("text", "")})
            if "image/png" in data:
                name = f"{path.stem}-{len(figures) + 1}.png"
                figures[name] = base64.b64decode(data["image/png"])
                parts.append(f"![Figure that the code above draws]({name})")
            elif "text/html" in data:
                html = _PANDAS.sub("", "".join(data["text/html"])).strip()
                parts.append(f'<div class="output">{html}</div>')
            else:
                shown = escape("".join(data["text/plain"]).rstrip())
                parts.append(f'<pre class="output">{shown}</pre>')
    return "\n\n".join(parts) + "\n", figures


def _outputs(text: str, names: dict[str, Any], number: int) -> Iterator[Output]:
    """Run a cell; yield what it printed, and the value of its last expression."""
    tree = ast.parse(text)
    last = tree.body[-1] if tree.body else None
    is_shown = isinstance(last, ast.Expr) and not text.rstrip().endswith(";")
    value = None
    with redirect_stdout(StringIO()) as printed:
        module = ast.Module(tree.body[:-1] if is_shown else tree.body, [])
        exec(compile(module, "cell", "exec"), names)  # noqa: S102  (our own notebooks)
        if is_shown and isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)  # noqa: S307
    if printed.getvalue():
        yield {"name": "stdout", "output_type": "stream", "text": _lines(printed.getvalue())}
    if value is not None:
        data = {"text/plain": _lines(repr(value))}
        # Those of xarray differ each time, and are large.
        if hasattr(value, "_repr_html_") and not type(value).__module__.startswith("xarray"):
            data["text/html"] = _lines(value._repr_html_())
        yield {
            "data": data,
            "execution_count": number,
            "metadata": {},
            "output_type": "execute_result",
        }


def _lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)


def _figures() -> Iterator[Output]:
    """Yield open figures as PNG, and close them."""
    from matplotlib import pyplot as plt  # noqa: PLC0415  (after the choice of the backend)

    for number in plt.get_fignums():
        content = BytesIO()
        plt.figure(number).savefig(content, format="png", dpi=_DPI, bbox_inches="tight")
        code = base64.b64encode(content.getvalue()).decode()
        data = {"image/png": code, "text/plain": ["<Figure>"]}
        yield {"data": data, "metadata": {}, "output_type": "display_data"}
    plt.close("all")


def check(path: Path) -> None:
    """Compare the text of stored outputs with what the cells give now."""
    notebooks = json.loads(path.read_text(encoding="utf-8")), run_notebook(path)
    stored, now = ("".join(texts_of(notebook)).splitlines() for notebook in notebooks)
    difference = "\n".join(unified_diff(stored, now, "stored", "now", lineterm=""))
    if difference:
        sys.exit(f"{path.name}: other outputs are stored; run tools/notebooks.py\n{difference}")


def main(arguments: Sequence[str]) -> None:
    """Run notebooks, and store or compare what their cells show."""
    for name in arguments:
        if name == "--check":
            continue
        path = Path(name).resolve()
        if "--check" in arguments:
            check(path)
        else:
            store(path, run_notebook(path))
        sys.stdout.write(f"{name}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
