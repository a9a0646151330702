"""Settings from and to TOML, their resolved form and its hash.

Works on any tree of frozen dataclasses whose leaves are float, int, str, bool, or tuples of
these, optionally ``None``; the dataclasses themselves are in :mod:`hipsta_bids.settings`.
"""

import ast
import dataclasses
import difflib
import hashlib
import inspect
import json
import textwrap
import tomllib
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from hipsta_bids.errors import SettingsError
from hipsta_bids.group_settings import GroupSettings
from hipsta_bids.settings import Settings

T = TypeVar("T")

_LINE = 96


def load_settings(path: Path | None) -> Settings:
    """Read a user's TOML file; what it leaves out keeps its default.

    Parameters
    ----------
    path : Path or None
        The file; ``None`` gives the defaults.

    Returns
    -------
    Settings
        All settings.

    Raises
    ------
    SettingsError
        If the file cannot be read, or a key or a value in it is wrong.
    """
    return _load(path, Settings)


def load_group_settings(path: Path | None) -> GroupSettings:
    """Read settings of the group level; see :func:`load_settings`."""
    return _load(path, GroupSettings)


def _load(path: Path | None, kind: type[T]) -> T:
    if path is None:
        return kind()
    try:
        with path.open("rb") as file:
            values = tomllib.load(file)
    except OSError as error:
        raise SettingsError(
            f"{path}: settings cannot be read ({error.strerror}); check the path",
            reason="settings-unreadable",
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(
            f"{path}: not a TOML file ({error}); start from `hipsta-bids settings`",
            reason="settings-not-toml",
        ) from error
    return settings_from(values, kind, where=str(path))


def settings_from(values: Mapping[str, Any], kind: type[T], *, where: str, prefix: str = "") -> T:
    """Build a settings dataclass from nested tables.

    Parameters
    ----------
    values : mapping
        What a TOML file says.
    kind : type
        A dataclass.
    where : str
        File name for messages.
    prefix : str
        Name of the table, with its final dot.

    Returns
    -------
    kind
        With defaults for what ``values`` leaves out.

    Raises
    ------
    SettingsError
        If a key is unknown (with the nearest known one) or a value has the wrong type or range.
    """
    hints = get_type_hints(kind)
    names = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]  # any dataclass
    chosen = {}
    for key, value in values.items():
        if key not in names:
            raise SettingsError(
                f"{where}: unknown setting {prefix}{key}; {_suggest(key, names)}",
                reason="unknown-setting",
            )
        hint = hints[key]
        if not (isinstance(hint, type) and dataclasses.is_dataclass(hint)):
            chosen[key] = _convert(value, hint, f"{where}: {prefix}{key}")
        elif isinstance(value, Mapping):
            chosen[key] = settings_from(value, hint, where=where, prefix=f"{prefix}{key}.")
        else:
            raise SettingsError(
                f"{where}: {prefix}{key} is a group of settings; write it as a table"
                f" [{prefix}{key}]",
                reason="bad-setting",
            )
    try:
        return kind(**chosen)
    except ValueError as error:  # the dataclass's own check of ranges
        raise SettingsError(
            f"{where}: {prefix.rstrip('.') or 'settings'}: {error}", reason="bad-setting"
        ) from error


def _suggest(key: str, names: list[str]) -> str:
    near = difflib.get_close_matches(key, names, n=1)
    if near:
        return f"did you mean {near[0]}?"
    return f"known here: {', '.join(names)}"


def _convert(value: object, hint: Any, where: str) -> object:  # noqa: ANN401  (a type hint)
    """Check one value against the type of its field; whole numbers may stand for floats."""
    choices = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    for choice in choices:
        fits, converted = _fit(value, choice)
        if fits:
            return converted
    raise SettingsError(
        f"{where} is {value!r}, but has to be {_describe(choices)}", reason="bad-setting"
    )


def _fit(value: object, hint: Any) -> tuple[bool, object]:  # noqa: ANN401  (a type hint)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return value in arguments, value
    if origin is tuple:
        return _fit_tuple(value, arguments)
    # bool is an int to Python, but not to a person.
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return True, float(value)
    if hint is int and isinstance(value, bool):
        return False, None
    return isinstance(hint, type) and isinstance(value, hint), value


def _fit_tuple(value: object, arguments: tuple[Any, ...]) -> tuple[bool, object]:
    if not isinstance(value, (list, tuple)):
        return False, None
    any_length = len(arguments) == 2 and arguments[1] is Ellipsis  # noqa: PLR2004  (tuple[X, ...])
    kinds = [arguments[0]] * len(value) if any_length else list(arguments)
    if len(kinds) != len(value):
        return False, None
    fitted = [_fit(item, kind) for item, kind in zip(value, kinds, strict=True)]
    return all(fits for fits, _ in fitted), tuple(item for _, item in fitted)


def _describe(choices: tuple[Any, ...]) -> str:
    words = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
    described = []
    for choice in choices:
        if get_origin(choice) is Literal:
            described += [repr(option) for option in get_args(choice)]
        elif get_origin(choice) is tuple:
            described.append(f"a list like {choice}".replace("tuple", ""))
        elif choice is not types.NoneType:
            described.append(words.get(choice, str(choice)))
    return " or ".join(described)


def resolve(settings: Any) -> dict[str, Any]:  # noqa: ANN401  (any dataclass)
    """Turn settings into nested dictionaries of plain values, every default filled in.

    Parameters
    ----------
    settings : dataclass instance
        All settings.

    Returns
    -------
    dict
        Ready for JSON.
    """
    resolved: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(settings)))
    return resolved


def settings_hash(settings: Any) -> str:  # noqa: ANN401  (any dataclass)
    """Hash the resolved settings.

    Parameters
    ----------
    settings : dataclass instance
        All settings.

    Returns
    -------
    str
        SHA-256, 64 hexadecimal digits; independent of the order of fields.
    """
    canonical = json.dumps(resolve(settings), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def flatten(resolved: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Name each leaf of resolved settings by its dotted path.

    Parameters
    ----------
    resolved : mapping
        From :func:`resolve`.
    prefix : str
        Put before each name.

    Returns
    -------
    dict
        ``{"body.layer_rule": ...}``.
    """
    flat: dict[str, Any] = {}
    for key, value in resolved.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def settings_toml(settings: Any) -> str:  # noqa: ANN401  (any dataclass)
    """Write settings as TOML, each with its meaning as a comment.

    Parameters
    ----------
    settings : dataclass instance
        All settings.

    Returns
    -------
    str
        A file that :func:`load_settings` reads back to the same settings.
    """
    return "\n".join(_toml_lines(settings, "")).strip() + "\n"


def _toml_lines(group: Any, prefix: str) -> Iterator[str]:  # noqa: ANN401  (any dataclass)
    """Write the leaves of one group first, then its tables, as TOML demands."""
    yield from _comment(inspect.getdoc(type(group)) or "")
    if prefix:
        yield f"[{prefix.rstrip('.')}]"
    meanings = field_meanings(type(group))
    nested = []
    for field in dataclasses.fields(group):
        value = getattr(group, field.name)
        if dataclasses.is_dataclass(value):
            nested.append((field.name, value))
            continue
        yield from _comment(meanings.get(field.name, ""))
        yield f"# {field.name} is not set" if value is None else f"{field.name} = {_toml(value)}"
    for name, value in nested:
        yield ""
        yield from _toml_lines(value, f"{prefix}{name}.")


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return json.dumps(value)  # TOML writes numbers, booleans and basic strings as JSON does


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(" ".join(text.split()), _LINE)]


def field_meanings(kind: type) -> dict[str, str]:
    """Read the docstrings that follow the fields of a dataclass in its source.

    Parameters
    ----------
    kind : type
        A dataclass.

    Returns
    -------
    dict of str to str
        Meaning per field that has one.
    """
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    meanings: dict[str, str] = {}
    name = None
    for node in tree.body if isinstance(tree, ast.ClassDef) else []:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            name = node.target.id
        elif name and isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            meanings[name] = inspect.cleandoc(str(node.value.value))
            name = None
        else:
            name = None
    return meanings
