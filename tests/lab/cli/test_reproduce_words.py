# SPDX-License-Identifier: Apache-2.0
import pytest

from stereovox.cli import main


@pytest.mark.parametrize(("paper", "said"), [("ist", "ist2019"), ("chien", "chien2020")])
def test_a_paper_that_is_not_there(paper, said, tmp_path, capsys):
    assert main(["reproduce", paper, "--out", str(tmp_path)]) == 2
    captured = capsys.readouterr()
    assert said in captured.err
    assert captured.err.count("\n") == 1


@pytest.mark.parametrize(
    ("paper", "camera", "said"),
    [("chien2020", "d345", "did you mean 'd435'"), ("ist2019", "d435", "ist2019 has a camera of its own")],
)
def test_a_camera_that_is_not_there(paper, camera, said, tmp_path, capsys):
    assert main(["reproduce", paper, "--out", str(tmp_path / "r"), "--camera", camera]) == 2
    assert said in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "r").exists()
