"""Settings as TOML files: reading, printing, hashing."""

import ast
import hashlib
import inspect
import json
import textwrap
import tomllib
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from hipsta_bids import opening
from hipsta_bids.errors import MissingSettingsError, SettingsError
from hipsta_bids.types.tables import Table, TomlTable, settings_from

_LINE = 96


def read_settings(path: Path | None, kind: type[Table]) -> Table:
    """Read a TOML file as settings of some kind; settings that it omits keep their defaults."""
    if path is None:
        return kind()
    try:
        values = tomllib.loads(opening.read_text(path, opening.SETTINGS))
    except OSError as error:
        is_missing = isinstance(error, FileNotFoundError)
        raise (MissingSettingsError if is_missing else SettingsError)(
            f"{path}: settings cannot be read ({error.strerror}); check the path"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise SettingsError(
            f"{path}: not a TOML file ({error}); start from `hipsta-bids settings`"
        ) from error
    return settings_from(values, kind, origin=str(path))


def resolve(settings: BaseModel) -> dict[str, Any]:
    """Turn settings into nested dictionaries of plain values, every default filled in."""
    return settings.model_dump(mode="json")


def settings_hash(settings: BaseModel) -> str:
    """Hash the resolved settings."""
    canonical = json.dumps(resolve(settings), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def flatten(resolved: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Name each leaf of resolved settings by its dotted path."""
    flat: dict[str, Any] = {}
    for key, value in resolved.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def settings_toml(settings: BaseModel) -> str:
    """Write settings as TOML, each with its meaning as a comment."""
    return "\n".join(_toml_lines(settings, "")).strip() + "\n"


def _toml_lines(group: BaseModel, prefix: str) -> Iterator[str]:
    """Write the leaves of one group first, then its tables, as TOML demands."""
    yield from _comment(inspect.getdoc(type(group)))
    if prefix:
        yield f"[{prefix.rstrip('.')}]"
    nested, meanings = [], read_meanings(type(group))
    for name in type(group).model_fields:
        value = getattr(group, name)
        if isinstance(value, BaseModel):
            nested.append((name, value))
            continue
        yield from _comment(meanings.get(name))
        # TOML writes numbers, booleans, basic strings and lists as JSON does.
        yield f"{name} = {json.dumps(value)}"
    for name, table in nested:
        yield ""
        yield from _toml_lines(table, f"{prefix}{name}.")


def read_meanings(kind: type[BaseModel]) -> dict[str, str]:
    """Read the docstrings of fields, by name, from the source of a class and its bases."""
    meanings: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if issubclass(base, TomlTable):
            (definition,) = ast.parse(inspect.getsource(base)).body
            for field, text in pairwise(definition.body):  # type: ignore[attr-defined]  # a class
                if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                    meanings[ast.unparse(field.target)] = ast.literal_eval(text.value)
    return meanings


def _comment(text: str | None) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(" ".join((text or "").split()), _LINE)]
