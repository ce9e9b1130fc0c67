# SPDX-License-Identifier: Apache-2.0
import pytest

from stereovox.cli import main
from stereovox.errors import MAX_PRINTED, printed, shortened


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
