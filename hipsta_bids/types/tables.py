"""Checked tables of values, as of settings: models, and one line for a mistake."""

import difflib
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Self, TypeVar, cast, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    Strict,
    ValidationError,
    create_model,
)

from hipsta_bids.errors import SettingsError

#: What a value has to be, by pydantic's type of mistake; braces take its limits.
_EXPECTED = {
    "bool_type": "true or false",
    "float_type": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "string_type": "a text",
    "tuple_type": "a list",
    "list_type": "a list",
    "model_type": "a table of keys and values",
    "literal_error": "{expected}",
    "greater_than": "above {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "below {lt:g}",
    "less_than_equal": "at most {le:g}",
    "too_short": "a list of at least {min_length}",
    "value_error": "{error}",
}


class TomlTable(BaseModel):
    """A table of a TOML file; nothing is converted but whole numbers to floats."""

    # Workers get their settings pickled and need no validator: it is built where one is used.
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, defer_build=True)


Table = TypeVar("Table", bound=TomlTable)


class SettingsTable(TomlTable):
    """A group of settings; the docstrings of its fields are their meanings."""

    def changed(self, **values: object) -> Self:
        """Return a copy with other, checked values; a mapping changes some values of a group."""
        groups = {
            name: dict(getattr(self, name)) | dict(value)
            for name, value in values.items()
            if isinstance(value, Mapping)
        }
        return settings_from({**dict(self), **values, **groups}, type(self), origin="settings")


class ExtendedSettings(SettingsTable):
    """All settings of a level, to which extensions add tables."""

    def of(self, kind: type[Table]) -> Table:
        """Return the table of an extension, by its class."""
        return next(table for _, table in self if isinstance(table, kind))

    @classmethod
    def extended(cls, further: Mapping[str, type[SettingsTable]]) -> type[Self]:
        """Return the class with further tables, by name, at their defaults.

        A table of a name that exists adds its settings to that table.
        """
        fields: dict[str, Any] = {}
        for name, addition in further.items():
            core: Any = cls.model_fields[name].annotation if name in cls.model_fields else None
            kind: Any = addition if core is None else _joined(core, addition)
            fields[name] = kind, kind()
        return create_model(
            cls.__name__, __base__=cls, __module__=cls.__module__, __doc__=cls.__doc__, **fields
        )


def _joined(core: type[SettingsTable], addition: type[SettingsTable]) -> type[SettingsTable]:
    """Return the class of a table with the settings of two."""
    about = {"__module__": core.__module__, "__doc__": core.__doc__}
    return create_model(core.__name__, __base__=(core, addition), **about)  # type: ignore[call-overload, no-any-return]  # of keywords in a mapping


def _odd(value: int) -> int:
    if value % 2 == 0:
        raise ValueError("an odd number")
    return value


Fraction = Annotated[float, Field(ge=0, le=1)]
PositiveFraction = Annotated[float, Field(gt=0, le=1)]
OpenFraction = Annotated[float, Field(gt=0, lt=1)]
Odd = Annotated[int, Field(ge=3), AfterValidator(_odd)]
# TOML has lists, and settings do not change: these become tuples.
Numbers = Annotated[tuple[NonNegativeFloat, ...], Strict(strict=False)]
Lengths = Annotated[tuple[PositiveFloat, ...], Strict(strict=False), Field(min_length=1)]
OpenFractions = Annotated[tuple[OpenFraction, ...], Strict(strict=False), Field(min_length=1)]
Texts = Annotated[tuple[str, ...], Strict(strict=False)]


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Name the nearest known name as a question, or nothing if none is near."""
    near = difflib.get_close_matches(name, list(names), n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def first_mistake(error: ValidationError, kind: type[BaseModel]) -> str:
    """Return the first mistake, unknown keys before all else."""
    # A mistyped key is also a missing one, but says more.
    mistake = min(error.errors(), key=lambda fault: fault["type"] != "extra_forbidden")
    position, value, words = mistake["loc"], mistake["input"], mistake["type"]
    name = _name(position)
    table, colon, key = name.rpartition(": ")
    if words == "extra_forbidden":
        known_names = _table_at(kind, position[:-1]).model_fields
        hint = (
            did_you_mean(str(position[-1]), known_names)
            or f"; known here: {', '.join(known_names)}"
        )
        return f"{table}{colon}unknown key {key}{hint}"
    if words == "missing":
        return f"{table}{colon}key {key} is missing"
    expected = _EXPECTED.get(words, "{msg}").format(msg=mistake["msg"], **mistake.get("ctx", {}))
    if isinstance(value, Mapping | BaseModel):  # a rule on several of its values
        return f"{name}: {expected}".removeprefix(": ")
    return f"{name} is {value!r}, but has to be {expected}"


def _name(position: Iterable[str | int]) -> str:
    """Name a value as in ``body.region`` or ``entry 2 of labels: code``."""
    name = ""
    for key in position:
        name = f"entry {key + 1} of {name[:-1]}: " if isinstance(key, int) else f"{name}{key}."
    return name.rstrip(".: ")


def _table_at(kind: Any, position: Iterable[str | int]) -> type[BaseModel]:  # noqa: ANN401  (of fields)
    for key in position:
        if parts := get_args(kind):  # of a list, or of a mapping from keys to values
            kind = parts[1 if get_origin(kind) is dict else 0]
        else:
            kind = kind.model_fields[key].annotation
    return cast("type[BaseModel]", kind)


def settings_from(values: Mapping[str, Any], kind: type[Table], *, origin: str) -> Table:
    """Make settings of nested tables, or name the first mistake in them."""
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        mistake = first_mistake(error, kind)
        raise SettingsError(f"{origin}: {mistake}") from error
