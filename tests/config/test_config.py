# SPDX-License-Identifier: Apache-2.0
"""Settings: what is unknown or out of range is refused in one line, and what is saved can be read again."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereovox.config import MAX_CELLS, Config, load_config, parse_value, profile_names
from stereovox.errors import ConfigError, did_you_mean


def refused(*words, profile="default", **overrides):
    """Assert that these settings are refused with one line that has all `words`; return the line."""
    with pytest.raises(ConfigError) as error:
        load_config(profile, **overrides)
    line = str(error.value)
    assert "\n" not in line
    for word in words:
        assert word in line
    return line


@pytest.mark.parametrize("name", profile_names())
def test_every_built_in_profile_loads(name):
    assert load_config(name).profile == name


def test_overrides_reach_into_sections_and_leave_the_rest():
    config = load_config(voxel_size=0.1, **{"map.free_below": 0.2, "noise.subpixel": 0.1, "sensor.p_hit": 0.8})
    assert (config.voxel_size, config.map.free_below, config.noise.subpixel) == (0.1, 0.2, 0.1)
    assert config.sensor.parameters() == {"p_hit": 0.8}
    default = load_config()
    assert config.map.occupied_above == default.map.occupied_above
    assert config.sensor.model == default.sensor.model
    assert config.max_range == default.max_range


def test_a_profile_file_overrides_the_default_and_is_overridden(tmp_path):
    path = tmp_path / "my robot.toml"
    path.write_text('voxel_size = 0.25\nmax_range = 8.0\n[sensor]\nmodel = "andert"\n')
    config = load_config(path, voxel_size=0.5)
    assert (config.profile, config.voxel_size, config.max_range) == ("my robot", 0.5, 8.0)
    assert config.sensor.model == "andert"
    assert load_config(str(path)) == load_config(path)


def test_what_is_saved_can_be_read_again():
    config = load_config(voxel_size=0.1, threads=2, **{"sensor.model": "valenti", "sensor.p_free": 0.3})
    assert load_config(config.model_dump()) == config
    assert load_config(config) == config
    assert load_config(config, threads=1).sensor == config.sensor


def test_overrides_never_change_what_they_were_given():
    settings = {"map": {"free_below": 0.2}}
    load_config(settings, **{"map.free_below": 0.1})
    assert settings == {"map": {"free_below": 0.2}}


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("voxel_sise", "voxel_size"),
        ("map.log_odds_mx", "log_odds_max"),
        ("noise.sub_pixel", "subpixel"),
        ("ray.updat", "update"),
        ("maps", "map"),
    ],
)
def test_unknown_settings_suggest_the_nearest(name, meant):
    refused(name, f"did you mean '{name.rpartition('.')[0] + '.' if '.' in name else ''}{meant}'?", **{name: 1})


@pytest.mark.parametrize("value", [20, [20, 20], [1, 2, 3, 4], "large"])
def test_a_list_of_the_wrong_length_is_told_how_long_it_must_be(value):
    line = refused(**{"window.size": value})
    assert line == f"window.size {value!r}: give a list of 3 numbers, [x, y, z]"
    assert "give a list of 2 numbers" in refused(**{"sphere.polar_deg": 3})
    assert "window.size.0 'a': Input should be a valid number" in refused(**{"window.size": ["a", 2, 3]})


def test_only_a_file_is_named_before_a_wrong_setting(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("max_range = 0.05\n")
    said = "settings: min_range 0.1 must be smaller than max_range 0.05"
    assert refused(profile=path) == f"{path}: {said}"
    assert refused(max_range=0.05) == said
    for profile in ("default", "chien2020"):
        assert refused(profile=profile, voxel_sise=1).startswith("unknown setting 'voxel_sise'")


def test_an_unknown_setting_in_a_file_names_the_file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("voxelsize = 0.1\n")
    refused("mine.toml", "voxelsize", "did you mean 'voxel_size'?", profile=path)


OUT_OF_RANGE = {
    "voxel_size": [0, -0.1, float("nan"), float("inf"), "small", 101],
    "max_range": [0, -1, 1001, 0.05],
    "min_range": [-0.1, 5.0],
    "threads": [0, -1, 1.5, 257],
    "pose_rigidity_tolerance": [0, 0.2],
    "map.log_odds_min": [0, -31],
    "map.log_odds_max": [0, 31],
    "map.free_below": [0, 1, 0.9],
    "map.occupied_above": [0, 1, 0.05],
    "map.missed_obstacle": [1, float("nan")],
    "map.false_alarm": [1, 0.5],
    "noise.subpixel": [0],
    "noise.s0": [-1],
    "noise.default_baseline": [0],
    "ray.update": ["sometimes"],
    "sensor.model": [3],
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name in OUT_OF_RANGE for value in OUT_OF_RANGE[name]])
def test_values_out_of_range_are_refused(name, value):
    line = refused(**{name: value})
    section, _, key = name.rpartition(".")
    assert key in line or f"{section}:" in line


def test_a_range_of_too_many_cells_is_refused():
    refused("use larger cells", voxel_size=0.001, max_range=0.002 * MAX_CELLS)


def test_a_section_is_not_a_value_and_a_value_not_a_section():
    refused("map", map=3)
    refused("voxel_size", **{"voxel_size.deep": 1})
    refused("'integrator' is a value, not a section", **{"integrator.deep": 1})


@pytest.mark.parametrize(
    ("content", "said"),
    [("voxel_size = = 1", "not valid TOML"), (b"\xff\xfe\x00", "cannot read"), (None, "cannot read")],
)
def test_bad_profile_files(tmp_path, content, said):
    path = tmp_path / "p.toml"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert "Errno" not in refused(str(path), said, profile=path)


def test_an_unknown_profile_names_the_known():
    refused("unknown profile 'defualt'", "did you mean 'default'?", profile="defualt")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.5", 0.5),
        ("3", 3),
        ("true", True),
        ("[1, 2]", [1, 2]),
        ("ray", "ray"),
        ('"3"', "3"),
        ("", ""),
        ("a b", "a b"),
    ],
)
def test_command_line_values(text, value):
    parsed = parse_value(text)
    assert parsed == value
    assert type(parsed) is type(value)


@given(st.text(max_size=30))
def test_any_command_line_value_is_parsed_without_failing(text):
    parse_value(text)


@given(st.dictionaries(st.sampled_from(sorted(Config.model_fields)), st.one_of(st.none(), st.floats(), st.text())))
def test_any_settings_are_taken_or_refused_in_one_line(settings):
    try:
        line = str(load_config(settings))
    except ConfigError as error:
        line = str(error)
    assert "\n" not in line


def test_config_cannot_be_changed_by_accident():
    with pytest.raises(ValueError, match="frozen"):
        load_config().voxel_size = 1.0


def test_did_you_mean_lists_all_where_nothing_is_near():
    assert did_you_mean("zebra", ["map", "info"]) == " (known: info, map)"
    assert did_you_mean("zebra", []) == ""


def test_a_fixed_box_needs_a_size():
    refused("window.centre needs window.size", **{"window.centre": [1, 2, 3]})
    assert load_config(**{"window.centre": [1, 2, 3], "window.size": [4, 4, 4]}).window.centre == (1, 2, 3)


@pytest.mark.parametrize("memory", ["5 XB", "abc", -5, float("nan"), "1e3 kB"])
def test_a_size_that_is_none_is_told_how_to_write_one(memory):
    refused("max_memory", 'give bytes, or a size like "500 MB"', max_memory=memory)


def test_up_that_is_no_axis_is_refused_with_the_axes_there_are():
    refused("up", "give x, y, z, -x, -y or -z", up="q")


def test_unknown_values_are_refused_by_name():
    with pytest.raises(ConfigError, match=r"depth\.far"):
        load_config("default", **{"depth.far": "said"})
