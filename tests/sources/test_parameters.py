# SPDX-License-Identifier: Apache-2.0
import inspect

import pytest

from stereovox import registry
from stereovox.errors import SourceError
from stereovox.simulate.simulation import SCENES, Options
from stereovox.sources.parameters import defaults, split, typed

KNOWN = {"size": "large", "distance": 2.0, "frames": 120, "noise": True}


def test_a_location_is_taken_apart():
    assert split("box") == ("box", {})
    assert split("box?") == ("box", {})
    assert split("box?size=small&distance=2.5") == ("box", {"size": "small", "distance": "2.5"})


def test_values_get_the_types_of_the_defaults():
    values = typed({"size": "small", "distance": "-1e-1", "frames": "7", "noise": "off"}, KNOWN)
    assert values == {"size": "small", "distance": -0.1, "frames": 7, "noise": False}
    assert [type(value) for value in values.values()] == [str, float, int, bool]


@pytest.mark.parametrize("text", ["size", "size=", "=small", "size=small&size=large"])
def test_what_is_no_parameter_is_refused(text):
    with pytest.raises(SourceError, match=r"write key=value|given twice"):
        split(f"box?{text}")


@pytest.mark.parametrize(
    ("key", "text", "complaint"),
    [
        ("sise", "small", r"unknown parameter 'sise' \(did you mean 'size'\?\)"),
        ("distance", "far", "distance=far must be a number"),
        ("distance", "nan", "distance=nan must be a finite number"),
        ("frames", "1.5", "frames=1.5 must be a whole number"),
        ("noise", "2", "noise=2 must be 1 or 0"),
        ("frames", "-" + "9" * 400, "frames=-9+ is too large"),
    ],
)
def test_bad_values_name_key_value_and_cure(key, text, complaint):
    with pytest.raises(SourceError, match=complaint) as caught:
        typed({key: text}, KNOWN)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("scene", SCENES)
def test_scenes_keep_to_parameters_that_can_be_written(scene):
    build = registry.find("scenes", SCENES, scene)
    parameters = defaults(build)
    assert all(type(value) in (str, float, int, bool) for value in parameters.values())
    assert not parameters.keys() & defaults(Options).keys(), "one name must not mean two things"
    assert all(parameter.kind is parameter.KEYWORD_ONLY for parameter in inspect.signature(build).parameters.values())
    written = {key: str(int(value) if value is True else value) for key, value in parameters.items()}
    assert typed(written, parameters) == parameters
