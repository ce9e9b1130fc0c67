# SPDX-License-Identifier: Apache-2.0
import pytest

from stereovox.cli import main


@pytest.mark.parametrize(("paper", "said"), [("ist", "ist2019"), ("chien", "chien2020")])
def test_a_paper_that_is_not_there(paper, said, tmp_path, capsys):
    assert main(["reproduce", paper, "--out", str(tmp_path)]) == 2
    captured = capsys.readouterr()
    assert said in captured.err
    assert captured.err.count("\n") == 1
