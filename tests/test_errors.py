# SPDX-License-Identifier: Apache-2.0
import ast
from collections import ChainMap
from pathlib import Path

import pytest

from stereovox.cli import main
from stereovox.errors import MAX_PRINTED, printed, shortened

SOURCES = Path(__file__).resolve().parents[1] / "src/stereovox"


@pytest.mark.parametrize("length", [3, 100])
@pytest.mark.parametrize("more", [0, 1, 2, 900])
def test_the_middle_of_a_long_text_is_left_out(length, more):
    text = f"/a{'x' * (length + more - 4)}/b" if more else "y" * length
    found = shortened(text, length)
    assert len(found) == length if more else found == text
    if length > 3 and more:
        assert (found[:2], found[-2:], "..." in found) == ("/a", "/b", True)


def test_a_message_keeps_its_cure_whatever_the_length_of_its_paths():
    names = [f"/{'deep folder/' * 90}a", f"/{'d' * 4000}/b.png"]
    message = f"{names[0]}: {names[1]}: holds nothing; write it again"
    found = printed(message, names)
    assert len(found) <= MAX_PRINTED
    assert found.endswith("/b.png: holds nothing; write it again")
    assert "older/a: /ddd" in found
    assert printed("short: as it is", names) == "short: as it is"
    assert len(printed("many words " * 90)) == MAX_PRINTED


@pytest.mark.parametrize("command", [["info"], ["map", "--out", "a.svox"], ["export", "a.ply"], ["picture", "a.png"]])
@pytest.mark.parametrize("name", ["x" * 240, "long name " * 23, "d/" * 500, "e" * 5000])
def test_a_path_of_any_length_gives_a_line_of_300_characters(command, name, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([command[0], f"{name}.ply?depth_scale=5", *command[1:]]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert len(line) <= 300
    assert name[:15] in line


ERRORS = ("StereovoxError", "ConfigError", "SourceError", "MapFileError", "FrameRefused")
MAX_FIXED = 190
"""Characters of a message without what it quotes: a path of 80 characters and a value fit in a line of 300."""


def test_what_is_fixed_in_messages_leaves_room_for_a_path():
    texts, errors = {}, {}
    for path in SOURCES.rglob("*.py"):
        tree = ast.parse(path.read_text())
        texts[path] = dict(constants(tree))
        calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call) and node.args)
        errors[path] = [call for call in calls if getattr(call.func, "id", "") in ERRORS]  # the rest is dropped
    everywhere = {name: text for own in texts.values() for name, text in own.items()}
    lengths = {
        f"{path.relative_to(SOURCES)}:{call.lineno}": fixed(call.args[-1], ChainMap(texts[path], everywhere))
        for path, calls in errors.items()
        for call in calls
    }
    assert len(lengths) > 500
    assert {where: length for where, length in lengths.items() if length > MAX_FIXED} == {}


def test_fixed_parts_are_counted_with_constants_and_the_longer_branch():
    call = ast.parse('SourceError(f"{path}: write {FORMS}" + ("abc" if x else f"abcd{y}") + f"{\'!!\' if z else 1}")')
    assert fixed(call.body[0].value.args[0], {"FORMS": "1234567"}) == len(": write 1234567abcd!!")


def constants(tree):
    """Names and values of the texts of a module."""
    for node in tree.body:
        if isinstance(node, ast.Assign):
            names, value = node.targets[0], node.value
            several = isinstance(names, ast.Tuple) and isinstance(value, ast.Tuple)
            pairs = zip(names.elts, value.elts, strict=True) if several else [(names, value)]
            for name, text in pairs:
                if isinstance(name, ast.Name) and isinstance(text, ast.Constant) and isinstance(text.value, str):
                    yield name.id, text.value


def fixed(node, texts):
    """The number of characters of a message that are the same whatever it quotes."""
    if isinstance(node, ast.Constant):
        return len(node.value) if isinstance(node.value, str) else 0
    if isinstance(node, ast.JoinedStr):
        return sum(fixed(value, texts) for value in node.values)
    if isinstance(node, ast.FormattedValue):
        return fixed(node.value, texts)
    if isinstance(node, ast.BinOp):
        return fixed(node.left, texts) + fixed(node.right, texts)
    if isinstance(node, ast.IfExp):
        return max(fixed(node.body, texts), fixed(node.orelse, texts))
    return len(texts.get(node.id, "")) if isinstance(node, ast.Name) else 0


def test_an_option_without_a_value_is_one_line(capsys):
    assert main(["truth", "a", "--out=--"]) == 2
    assert "'--out=--': '--' is no value" in capsys.readouterr().err
