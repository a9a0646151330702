import pickle
import tomllib
from typing import Annotated, Literal

import pytest
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from hipsta_bids.errors import SettingsError
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.protocols.toml import flatten, read_meanings, resolve, settings_hash, settings_toml
from hipsta_bids.settings import Settings, load_settings
from hipsta_bids.types.tables import Numbers, Odd, SettingsTable, settings_from


class Inner(SettingsTable):
    """A stage."""

    length: PositiveFloat = 2.0
    """A length, mm."""
    count: int = 3
    """A count."""
    window: Odd = 5
    """A window."""
    rule: Literal["a", "b"] = "a"
    """A rule."""
    exact: bool = False
    """A switch."""

    @model_validator(mode="after")
    def _count_below_window(self):
        if self.count >= self.window:
            raise ValueError("count has to be below window")
        return self


class Outer(SettingsTable):
    """Everything."""

    title: str = 'x "quoted"'
    """A text."""
    steps: Numbers = (1.0,)
    """Steps."""
    limit: Annotated[float, Field(ge=0, le=4)] = 0.0
    """A limit, mm."""
    inner: Inner = Field(default_factory=Inner)


def test_file_overrides_defaults_and_keeps_the_rest(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text('[body]\nlayer_rule = "nearest-label"\n')
    assert load_settings(path).body.layer_rule == "nearest-label"
    assert load_settings(path).changed(body={"layer_rule": "nearest-sheet"}) == Settings()
    assert load_settings(None) == Settings()


def test_values_are_converted_to_their_fields_types():
    values = {"steps": [1, 2, 3], "limit": 4, "inner": {"length": 1, "rule": "b", "exact": True}}
    made = settings_from(values, Outer, origin="f")
    assert made.steps == (1.0, 2.0, 3.0)
    assert {type(value) for value in (made.limit, *made.steps, made.inner.length)} == {float}
    assert made.inner == Inner(length=1.0, rule="b", exact=True)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"titel": "x"}, r"unknown key titel \(did you mean 'title'\?\)"),
        ({"inner": {"lenght": 1}}, r"inner\.lenght \(did you mean 'length'"),
        ({"zzz": 1}, "unknown key zzz; known here: title, steps, limit, inner"),
        ({"inner": {"length": "1"}}, r"inner\.length is '1', .* a number"),
        ({"inner": {"count": 1.5}}, r"inner\.count is 1\.5, .* a whole number"),
        ({"inner": {"count": True}}, r"inner\.count is True, .* a whole number"),
        ({"inner": {"length": True}}, r"inner\.length is True, .* a number"),
        ({"inner": {"exact": 1}}, r"inner\.exact is 1, .* true or false"),
        ({"title": 1}, "title is 1, but has to be a text"),
        ({"inner": 3}, "inner is 3, but has to be a table"),
        ({"steps": 1}, "steps is 1, but has to be a list"),
        ({"steps": [1, "x"]}, "entry 2 of steps is 'x', but has to be a number"),
        ({"inner": {"rule": "c"}}, "'c', but has to be 'a' or 'b'"),
        ({"inner": {"length": -1}}, r"inner\.length is -1, .* above 0"),
        ({"inner": {"window": 6}}, r"window is 6, .* an odd number"),
        ({"limit": 4.5}, "limit is 4.5, but has to be at most 4"),
        ({"limit": float("nan")}, "limit is nan, but has to be at"),
        ({"inner": {"count": 5}}, "f: inner: count has to be below"),
        ({"limit": "x", "titel": "x"}, "unknown key titel"),
    ],
)
def test_wrong_values_are_named(values, message):
    with pytest.raises(SettingsError, match=message) as caught:
        settings_from(values, Outer, origin="f")
    assert str(caught.value).startswith("f: ")
    assert "\n" not in str(caught.value)
    assert (caught.value.exit_code, caught.value.reason) == (64, "")


def test_changed_values_are_checked():
    assert Outer().changed(inner={"count": 2}) == Outer(inner=Inner(count=2))
    with pytest.raises(SettingsError, match=r"settings: inner\.count is 'x'"):
        Outer().changed(inner={"count": "x"})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"grid": {"spacing": 2}}, r"grid\.spacing is 2, but has to be at most 1"),
        ({"measures": {"gaussian_window": 8}}, r"gaussian_window is 8, but has to be an odd"),
        ({"measures": {"curvature_order": 9}}, "measures: curvature_order has to be below"),
        ({"body": {"region": "head"}}, r"body\.region is 'head', .* 'body', 'extended'"),
    ],
)
def test_values_that_no_stage_could_work_with_are_refused(values, message):
    with pytest.raises(SettingsError, match=message):
        settings_from(values, Settings, origin="f")


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


@pytest.mark.parametrize("settings", [Settings(), GroupSettings(), Outer(limit=2.5)])
def test_printed_and_pickled_settings_read_back(settings):
    values = tomllib.loads(settings_toml(settings))
    assert settings_from(values, type(settings), origin="f") == settings
    assert pickle.loads(pickle.dumps(settings)) == settings  # noqa: S301 -- made here


def test_printed_settings_explain_themselves():
    text = settings_toml(Outer())
    assert "# A length, mm.\nlength = 2.0" in text
    assert "# A stage.\n[inner]" in text


def test_hash_depends_on_values_only():
    class Reordered(SettingsTable):
        inner: Inner = Field(default_factory=Inner)
        limit: NonNegativeFloat = 0.0
        steps: Numbers = (1.0,)
        title: str = 'x "quoted"'

    assert settings_hash(Outer()) == settings_hash(Reordered())
    assert settings_hash(Outer()) != settings_hash(Outer(limit=1.0))
    assert len(settings_hash(Outer())) == 64


def test_flat_names():
    assert flatten(resolve(Outer()))["inner.length"] == 2.0


@pytest.mark.parametrize("settings", [Settings(), GroupSettings()])
def test_every_setting_has_a_meaning_and_refuses_what_is_no_number(settings):
    for group, values in settings:
        meanings = read_meanings(type(values))
        for name, field in type(values).model_fields.items():
            assert meanings[name], name
            if field.annotation is float:
                with pytest.raises(SettingsError, match=f"{name} is nan"):
                    settings.changed(**{group: {name: float("nan")}})
