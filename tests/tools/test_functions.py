"""The limits of complexity and length of functions, on a source with known counts."""

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import functions
import pytest

SOURCE = '''
def count(rows, limit=1 if 2 else 3):
    """Docstring
    of two lines."""
    assert rows
    for row in rows:
        if row and limit or row:
            try:
                row()
            except ValueError:
                pass
        elif [cell for cell in row if cell if limit]:
            while row:
                match row:
                    case 1:
                        pass
                    case 2:
                        pass

    def inner():
        return 1 if rows else 2
'''


@pytest.mark.parametrize(
    ("limits", "listed", "message"),
    [
        ((15, 18), (), ""),
        ((14, 18), (), "module.py:count: complexity 15, 18 lines; the limits are 14 and 18."),
        ((15, 17), (), "module.py:count: complexity 15, 18 lines; the limits are 15 and 17."),
        ((14, 18), ("module.py:count",), ""),
        ((15, 18), ("module.py:count",), "module.py:count is not too large; remove it"),
        ((1, 18), ("module.py:count",), "module.py:inner: complexity 2, 2 lines;"),
    ],
)
def test_limits_are_exact_and_lists_are_current(
    limits: tuple[int, int],
    listed: tuple[str, ...],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "module.py").write_text(SOURCE)
    monkeypatch.setattr(functions, "MAX_COMPLEXITY", limits[0])
    monkeypatch.setattr(functions, "MAX_LINES", limits[1])
    monkeypatch.setattr(functions, "EXCEPTIONS", tuple((name, "reason") for name in listed))
    printed = StringIO()
    with redirect_stdout(printed):
        assert functions.main([str(tmp_path)]) == bool(message)
    assert printed.getvalue().startswith(message)
    assert bool(printed.getvalue()) == bool(message)


def test_exceptions_are_few() -> None:
    assert len(functions.EXCEPTIONS) <= 5
    assert all(reason for _, reason in functions.EXCEPTIONS)
