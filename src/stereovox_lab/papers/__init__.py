# SPDX-License-Identifier: Apache-2.0
"""Reproductions: experiments of papers on simulated recordings, with the paper's figures next to ours."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any

from stereovox.errors import StereovoxError, did_you_mean
from stereovox.simulate.simulation import CAMERAS
from stereovox_lab.papers.chapter import Progress

PAPERS = {
    "chien2020": "stereovox_lab.papers.chien2020:reproduce",
    "valenti2018": "stereovox_lab.papers.valenti2018:reproduce",
    "ist2019": "stereovox_lab.papers.ist2019:reproduce",
}
"""Function `(out, data, quick, progress) -> dict` of each paper; of those in WITH_CAMERA with a keyword `camera`."""
WITH_CAMERA = ("chien2020",)


def reproduce(
    paper: str,
    out: str | Path,
    *,
    data: str | Path | None = None,
    quick: bool = False,
    camera: str | None = None,
    audit: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Reproduce the experiments of a paper and write `report.html` and `numbers.json` into folder `out`.

    data: input besides simulation (chien2020: your own recording, also mapped;
    valenti2018: a folder with KITTI tracking sequences, or a drive of KITTI raw data; ist2019: your own bag,
    instead of the simulated ones).
    quick: fewer frames; enough to check that all works, not to quote. camera: of the simulated recordings (chien2020),
    as in their options: `simple`, `d435`, `kinect`. audit: only the claims on
    formulas, and which of them fall under each of many faults. Returns the numbers, fit for JSON.
    Raises StereovoxError, one line, for an unknown paper or camera.
    """
    if paper not in PAPERS:
        raise StereovoxError(f"unknown paper '{paper}'{did_you_mean(paper, PAPERS)}")
    progress = progress or (lambda done, total, text: None)
    if audit:
        return _audit(paper, Path(out), progress)
    module, _, name = PAPERS[paper].partition(":")
    run: Callable[..., dict[str, Any]] = getattr(import_module(module), name)
    return run(Path(out), data, quick, progress, **_camera(paper, camera))


def _audit(paper: str, out: Path, progress: Progress) -> dict[str, Any]:
    from stereovox_lab.papers.formulas.audit import formulas, steps
    from stereovox_lab.papers.output import Steps, output_files, write_result

    start, files = perf_counter(), output_files(out)
    found = formulas(paper, True, Steps(progress, steps(paper)).of("faults"))
    title = f"Formulas of {paper}, audited"
    return write_result(files, [found], perf_counter() - start, paper=paper, title=title, lead="", quick=False)


def _camera(paper: str, camera: str | None) -> dict[str, str]:
    if camera is None:
        return {}
    if paper not in WITH_CAMERA:
        raise StereovoxError(f"--camera {camera}: {paper} has a camera of its own; give it for {WITH_CAMERA[0]} only")
    if camera not in CAMERAS:
        raise StereovoxError(f"--camera {camera} is unknown{did_you_mean(camera, CAMERAS)}")
    return {"camera": camera}
