import tomllib
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Literal

import pytest

from hipsta_bids.errors import SettingsError
from hipsta_bids.settings import (
    Settings,
    field_meanings,
    flatten,
    load_settings,
    resolve,
    settings_from,
    settings_hash,
    settings_toml,
)


@dataclass(frozen=True, kw_only=True)
class Inner:
    """A stage."""

    length: float = 2.0
    """A length, mm."""
    count: int = 3
    """A count."""
    rule: Literal["a", "b"] = "a"
    """A rule."""
    exact: bool = False
    """A switch."""

    def __post_init__(self):
        if self.length <= 0:
            raise ValueError(f"length is {self.length}, but has to be above 0 mm")


@dataclass(frozen=True, kw_only=True)
class Outer:
    """Everything."""

    title: str = 'x "quoted"'
    """A text."""
    window: tuple[float, float] = (1.0, 2.0)
    """A window, mm."""
    steps: tuple[int, ...] = (1,)
    """Steps."""
    limit: float | None = None
    """A limit, mm."""
    inner: Inner = field(default_factory=Inner)


def test_file_overrides_defaults_and_keeps_the_rest(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text('[body]\nlayer_rule = "nearest-label"\n')
    assert load_settings(path).body.layer_rule == "nearest-label"
    assert load_settings(None) == Settings()


def test_values_are_converted_to_their_fields_types():
    values = {
        "window": [0, 3],
        "steps": [1, 2, 3],
        "limit": 4,
        "inner": {"length": 1, "rule": "b", "exact": True},
    }
    made = settings_from(values, Outer, where="f")
    assert made.window == (0.0, 3.0)
    assert isinstance(made.window[0], float)
    assert made.steps == (1, 2, 3)
    assert made.limit == 4.0
    assert made.inner == Inner(length=1.0, rule="b", exact=True)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"titel": "x"}, "unknown setting titel; did you mean title"),
        ({"inner": {"lenght": 1}}, r"unknown setting inner\.lenght; did you mean length"),
        ({"zzz": 1}, "unknown setting zzz; known here: title, window"),
        ({"inner": {"length": "1"}}, r"inner\.length is '1', but has to be a number"),
        ({"inner": {"count": 1.5}}, r"inner\.count is 1\.5, but has to be a whole number"),
        ({"inner": {"count": True}}, r"inner\.count is True, but has to be a whole number"),
        ({"inner": {"length": True}}, r"inner\.length is True, but has to be a number"),
        ({"inner": {"exact": 1}}, r"inner\.exact is 1, but has to be true or false"),
        ({"inner": {"rule": "c"}}, r"inner\.rule is 'c', but has to be 'a' or 'b'"),
        ({"inner": {"length": -1}}, r"inner: length is -1\.0, but has to be above 0 mm"),
        ({"inner": 3}, "inner is a group of settings"),
        ({"window": [1]}, "window is"),
        ({"window": 1}, "window is"),
        ({"steps": [1, "x"]}, "steps is"),
    ],
)
def test_wrong_values_are_named(values, message):
    with pytest.raises(SettingsError, match=message) as caught:
        settings_from(values, Outer, where="f")
    assert caught.value.exit_code == 64


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "cannot be read"), (b"a = [", "not a TOML file"), (b"\xff\xfe", "not a TOML file")],
)
def test_unusable_files_are_named(tmp_path, content, message):
    path = tmp_path / "s.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SettingsError, match=message):
        load_settings(path)


@pytest.mark.parametrize("settings", [Settings(), Outer(limit=2.5)])
def test_printed_settings_read_back(settings):
    values = tomllib.loads(settings_toml(settings))
    assert settings_from(values, type(settings), where="f") == settings


def test_printed_settings_explain_themselves():
    text = settings_toml(Outer())
    assert "# A length, mm.\nlength = 2.0" in text
    assert "# A stage.\n[inner]" in text
    assert "# limit is not set" in text


def test_hash_depends_on_values_only():
    @dataclass(frozen=True, kw_only=True)
    class Reordered:
        inner: Inner = field(default_factory=Inner)
        limit: float | None = None
        steps: tuple[int, ...] = (1,)
        window: tuple[float, float] = (1.0, 2.0)
        title: str = 'x "quoted"'

    assert settings_hash(Outer()) == settings_hash(Reordered())
    assert settings_hash(Outer()) != settings_hash(Outer(limit=0.0))
    assert len(settings_hash(Outer())) == 64


def test_flat_names():
    assert flatten(resolve(Outer()))["inner.length"] == 2.0


def groups(kind):
    yield kind
    for entry in fields(kind):
        if is_dataclass(entry.default_factory):
            yield from groups(entry.default_factory)


@pytest.mark.parametrize("kind", list(groups(Settings)))
def test_every_setting_has_a_meaning(kind):
    meanings = field_meanings(kind)
    bare = [f.name for f in fields(kind) if not is_dataclass(f.default_factory)]
    assert [name for name in bare if not meanings.get(name)] == []
