"""The code that a record depends on: the modules that its suite imports, as hashes by folder.

Comments, docstrings and layout do not count, nor does git: a hash is of the syntax trees of a
folder's modules, and of its tables. It is the same under each version of Python.
"""

import ast
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import hipsta_bids

#: Where packages lie: that of an installed wheel is not in the checkout.
_ROOTS = (Path(hipsta_bids.__file__).parents[1], Path(__file__).resolve().parents[1])
#: What opens files, shows, names and writes results, and changes no number. Packages: the version
#: is in one.
_APART = re.compile(
    r"hipsta_bids|hipsta_bids\.(api|cli|derivatives|opening|reports)\b.*|validation|validation\.(report|sources)"
)
#: Modules that are named in texts: joints, and processes of their own.
_NAMED = re.compile(r"\"(hipsta_bids(?:\.\w+)+)[:\"]")
#: What can hold imports.
_STATEMENTS = (ast.stmt, ast.excepthandler, ast.match_case)
_DIGITS = 12

Code = Mapping[str, str]
"""Hashes by folder, such as ``hipsta_bids.geometry``, or by module of ``validation``."""


@cache
def code_of(*modules: str) -> Code:
    """Return the hashes of all code that modules import, themselves included, by folder."""
    paths: dict[str, Path] = {}
    queue = list(modules)
    while queue:
        module = queue.pop()
        path = _find(module)
        if module in paths or path is None or _APART.fullmatch(module):
            continue
        paths[module] = path
        queue += [*_imports(path), module.rpartition(".")[0]]
    folders: dict[str, set[Path]] = {}
    for module, path in paths.items():
        folders.setdefault(_folder(module), set()).update([path, *path.parent.glob("*.toml")])
    return {name: _hash(folders[name]) for name in sorted(folders)}


def changed(record: Mapping[str, Any], *modules: str) -> list[str]:
    """List the folders whose code differs from that of a record; all, if the record has none."""
    now, then = code_of(*modules), record.get("code", {})
    names = {name for name in {*now, *then} if not _APART.fullmatch(name)}
    return sorted(name for name in names if now.get(name) != then.get(name))


def _folder(module: str) -> str:
    parts = module.split(".")
    return ".".join(parts[: 3 if parts[1] == "extensions" else 2])


@cache
def _find(module: str) -> Path | None:
    """Return the file of a module of this project."""
    if module.partition(".")[0] not in {"hipsta_bids", "validation", "benchmarks"}:
        return None
    for root in _ROOTS:
        place = root.joinpath(*module.split("."))
        for path in (place / "__init__.py", place.with_name(f"{place.name}.py")):
            if path.is_file():
                return path
    return None


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


@cache
def _imports(path: Path) -> list[str]:
    return [*_imported(_tree(path)), *_NAMED.findall(path.read_text("utf-8"))]


def _imported(node: ast.AST) -> Iterator[str]:
    """Yield what may be modules, without what is imported for type checkers alone."""
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        children: Iterable[ast.AST] = node.orelse
    else:
        children = ast.iter_child_nodes(node)
    if isinstance(node, ast.Import):
        yield from (name.name for name in node.names)
    elif isinstance(node, ast.ImportFrom):
        yield node.module or ""
        yield from (f"{node.module}.{name.name}" for name in node.names)
    for child in children:
        if isinstance(child, _STATEMENTS):
            yield from _imported(child)


def _hash(paths: set[Path]) -> str:
    texts = sorted(f"{path.name}: {_spell(path)}" for path in paths)
    return sha256("\n".join(texts).encode()).hexdigest()[:_DIGITS]


@cache
def _spell(path: Path) -> str:
    """Write a module, or a table, without what changes nothing."""
    if path.suffix == ".toml":
        return repr(tomllib.loads(path.read_text("utf-8")))
    return _dump(_tree(path))


def _dump(value: object) -> str:
    """Write a syntax tree; ``ast.dump`` differs between versions of Python."""
    if isinstance(value, list):
        return f"[{', '.join(_dump(item) for item in value if not _is_text(item))}]"
    if isinstance(value, ast.AST):
        # Fields that are empty came with later versions.
        fields = ((name, getattr(value, name, None)) for name in value._fields)
        kept = (f"{name}={_dump(part)}" for name, part in fields if part is not None and part != [])
        return f"{type(value).__name__}({', '.join(kept)})"
    return repr(value)


def _is_text(node: object) -> bool:
    """Return whether a statement is a docstring."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )
