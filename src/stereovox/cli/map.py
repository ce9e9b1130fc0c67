# SPDX-License-Identifier: Apache-2.0
"""Turn a recording into a map.

SOURCE is a 7-Scenes or TUM RGB-D folder, a camera pair, a RealSense .db3 or a ROS bag, all recognised by what they
hold, the simulation sim:room, or a connected camera, realsense:. Under a profile of two dimensions (ist2019) it is the
recording of a ground robot, as for `stereovox grid`.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.checkpoints import Checkpoints, add_checkpoint
from stereovox.cli.endings import check_ending
from stereovox.cli.live_page import NoPage, page_of, rerun_of
from stereovox.cli.robots import check_in_space
from stereovox.cli.settings import add_settings, overrides
from stereovox.cli.terminal import (
    cells_line,
    command_line,
    interrupt_between_steps,
    milliseconds,
    say,
    say_about_compiling,
    say_refusals,
    thousands,
    tracked,
)
from stereovox.errors import MapFileError, SourceError, StereovoxError, one_line

if TYPE_CHECKING:
    from stereovox.config import WindowConfig
    from stereovox.frame import AnyFrame
    from stereovox.mapper import Mapper
    from stereovox.maps import VoxelMap
    from stereovox.sources import Stream
    from stereovox.update_report import UpdateReport

PORT = 8080
PATIENCE = 100
"""Frames of a live camera that a run may refuse before the first that it does not."""
EXAMPLE = "stereovox map recordings/kitchen --out kitchen.svox --voxel-size 0.05"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", metavar="SOURCE", help="recorded folder or file, sim:room etc., or realsense:")
    parser.add_argument("--out", required=True, metavar="MAP", help="folder of the map to write, for example room.svox")
    parser.add_argument(
        "--profile", metavar="P", help="profile name or TOML file (default; with --resume the map's own settings)"
    )
    parser.add_argument("--voxel-size", type=float, metavar="M", help="cell size in metres")
    parser.add_argument("--integrator", metavar="NAME", help="projective (default), ray or line")
    parser.add_argument("--max-range", type=float, metavar="M", help="depth in metres up to which pixels count")
    parser.add_argument("--frames", metavar="A:B:S", help="only these frames, as a Python slice")
    parser.add_argument("--camera", metavar="FILE", help="camera file (camera.toml) that replaces the recording's own")
    parser.add_argument("--threads", type=int, metavar="N", help="threads (1); the map does not depend on it")
    add_settings(parser, "sensor.model=andert")
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on with the map at --out; as many frames of SOURCE are skipped as it has seen",
    )
    add_checkpoint(parser)
    parser.add_argument(
        "--view",
        type=int,
        nargs="?",
        const=PORT,
        metavar="PORT",
        help=f"show the map in a browser while it grows, and then until Ctrl-C ({PORT}; 0: any port that is free)",
    )
    parser.add_argument(
        "--rerun", metavar="FILE.rrd", help="write depth images, camera and the growing map for the Rerun viewer"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Map the source, save the map and tell what was done."""
    if _of_a_floor(arguments):
        return _grid(arguments)
    from stereovox.maps.lock import only_writer_in
    from stereovox.maps.store import sweep

    out = Path(arguments.out)
    check_ending("--rerun", arguments.rerun, ".rrd")
    _check_target(out, arguments.resume)
    with only_writer_in(out):
        sweep(out)
        return _mapped(arguments, out)


def _mapped(arguments: Namespace, out: Path) -> dict[str, Any]:
    from stereovox.evaluate.summary import summarise

    source = _opened(arguments)
    mapper = _mapper(arguments, out)
    try:
        checkpoints = Checkpoints(lambda: mapper.map.save(out), out, arguments.checkpoint)
        _check_recording(mapper, source, out)
        for note in source.notes:
            say(f"note: {note}")
        with page_of(mapper, out.stem, arguments.view) as page:
            say_about_compiling()
            with rerun_of(mapper, arguments.rerun) as recorded:
                reports = _made(mapper, source, out, checkpoints, (page, recorded))
                recorded.finish()
            result = summarise(mapper.map, reports) | ({"dropped": source.dropped} if source.length is None else {})
            page.finish()
            _tell(result, reports, out, mapper.config.window)
            page.stay()
    finally:
        mapper.map.close()
    return result


def _made(
    mapper: Mapper, source: Stream, out: Path, checkpoints: Checkpoints, watching: tuple[NoPage, ...]
) -> list[UpdateReport]:
    """Add all frames and save the map; raises StereovoxError where not one could be used."""
    with interrupt_between_steps() as check, _there_at_once(mapper.map, out):
        reports = _add_all(mapper, source, out, checkpoints, check, watching)
        if not mapper.map.frames:
            raise StereovoxError(
                f"{source.name}: not one frame could be used, no map is written ({_first_refusal(reports)})"
            )
        checkpoints.save(_seen(mapper))
    return reports


def _opened(arguments: Namespace) -> Stream:
    from stereovox.sources import open_stream

    source = open_stream(arguments.source, arguments.frames)
    if arguments.camera is None:
        return source
    from stereovox.sources.with_camera import with_camera

    return with_camera(source, arguments.camera)


@contextmanager
def _there_at_once(voxel_map: VoxelMap, out: Path) -> Iterator[None]:
    """Save a map that is new before its first frame: one that is killed is there; remove it if it stays empty."""
    from stereovox.maps.store import is_map, read_manifest, remove_map

    new = not is_map(out)
    if new:
        voxel_map.save(out)
    try:
        yield
    finally:
        if new and is_map(out) and not read_manifest(out)["frames"]:
            remove_map(out)


def _of_a_floor(arguments: Namespace) -> bool:
    """Tell whether the settings ask for the 2-D map of a ground robot, as profile ist2019 does."""
    from stereovox.config import load_config

    return load_config(arguments.profile or "default", **overrides(arguments)).dimensions == 2


def _grid(arguments: Namespace) -> dict[str, Any]:
    """Do what `stereovox grid` does; it has more options."""
    from stereovox.cli import grid

    for option in ("camera", "integrator", "threads", "view", "rerun"):
        if getattr(arguments, option) is not None:
            raise StereovoxError(f"--{option}: has no meaning for the map of a floor; leave it out")
    if arguments.resume and not Path(arguments.out).exists():
        raise StereovoxError(f"{arguments.out}: no map to go on with; leave --resume out")
    given = {**vars(arguments), "profile": arguments.profile or "default"}
    return grid.run(Namespace(**{**grid.defaults(), **given, "resume": arguments.out if arguments.resume else None}))


def _check_target(out: Path, resume: bool) -> None:
    """Find out before the work, not after it, that the map could not be saved."""
    from stereovox.maps.store import check_target, is_map

    check_in_space(out)
    check_target(out)
    if resume and not is_map(out):
        raise StereovoxError(f"{out}: no map to go on with; leave --resume out")


def _mapper(arguments: Namespace, out: Path) -> Mapper:
    from stereovox.mapper import Mapper
    from stereovox.maps import load_map

    saved = load_map(out) if arguments.resume else None
    settings = arguments.profile
    if settings is None:
        settings = saved.config if saved else "default"
    tiles = out.parent / f".{out.name}-tiles"  # beside the map, not in a temporary folder that may lie in memory
    return Mapper(settings, resume=saved, tiles=tiles, **overrides(arguments))


def _check_recording(mapper: Mapper, source: Stream, out: Path) -> None:
    """Frames are counted, not recognised: going on with another recording would skip its first ones."""
    made_of = mapper.map.recording
    if made_of and made_of != source.name:
        raise StereovoxError(
            f"{out}: was made of '{made_of}', not of '{source.name}'; go on with that or leave --resume out"
        )
    mapper.map.recording = source.name


def _add_all(
    mapper: Mapper,
    source: Stream,
    out: Path,
    checkpoints: Checkpoints,
    check: Callable[[], None],
    watching: tuple[NoPage, ...],
) -> list[UpdateReport]:
    """Add all frames that the map does not hold yet; where `check` says that it is enough, save what there is.

    watching: who is told of each frame.
    """
    reports: list[UpdateReport] = []
    done = _seen(mapper)
    if done:
        if source.length is not None and done > source.length:
            raise StereovoxError(
                f"{out}: holds {done} frames, more than the {source.length} of {source.name}; give the same --frames"
            )
        _check_last(mapper, source, done, out)
        if done == source.length:  # whoever starts a run again after a kill need not know that it was complete
            say(f"{out} already holds all {done} frames of {source.name}")
            return reports
        source = source.after(done)
        say(f"going on after frame {done}")
    try:
        for frame in tracked(source, source.length, "mapping"):
            reports.append(_added(mapper, frame, checkpoints))
            for one in watching:
                one.after(frame, reports[-1])
            check()
            if mapper.map.frames:  # an empty map must not take the place of an older one
                checkpoints.after(_seen(mapper))
            if source.length is None and len(reports) == PATIENCE and all(one.refused for one in reports):
                left = f"{out} stays as it is" if done else "no map is written"  # it would be refused for ever
                raise StereovoxError(
                    f"{source.name}: not one of {PATIENCE} frames could be used, {left} ({_first_refusal(reports)})"
                )
    except (KeyboardInterrupt, SourceError):
        if mapper.map.frames:
            checkpoints.save(_seen(mapper))
            say(f"stopped after {len(reports)} frames; they are saved in {out}, go on with --resume")
        raise
    return reports


def _check_last(mapper: Mapper, source: Stream, done: int, out: Path) -> None:
    """Frames are skipped by their number: under another --frames some would be missed, and others counted twice."""
    from stereovox.history import LONGEST_NAME

    last = mapper.map.history.last_frame
    if source.length is None or last is None:  # a live camera; a map from before this was saved
        return
    there = next(iter(source.after(done - 1)))
    if (one_line(there.name[:LONGEST_NAME]), there.stamp_ns) != last:
        raise StereovoxError(
            f"{out}: its frame {done} was '{last[0]}', here it is '{there.name}'; give --frames as before, or leave "
            "--resume out"
        )


def _added(mapper: Mapper, frame: AnyFrame, checkpoints: Checkpoints) -> UpdateReport:
    try:
        return mapper.add(frame)
    except MapFileError as error:  # no room for a tile; up to this frame the map is whole in memory
        checkpoints.save(_seen(mapper))
        raise MapFileError(f"{error}; {checkpoints.left()}") from None


def _seen(mapper: Mapper) -> int:
    """Return how many frames the map was offered."""
    return mapper.map.frames + mapper.map.frames_refused


def _first_refusal(reports: list[UpdateReport]) -> str:
    return next((report.detail for report in reports if report.refused), "the source is empty")


def _tell(result: dict[str, Any], reports: list[UpdateReport], out: Path, window: WindowConfig) -> None:
    from stereovox.health import FULL

    say_refusals(result, reports, "frames")
    if result.get("dropped"):
        say(f"  {result['dropped']} more came while the map was busy and were dropped; see --set deadline_ms=")
    if reduced := [f"{number} {way}" for way, number in result["ways"].items() if way != FULL]:
        say(f"for want of time: {', '.join(reduced)}")
    if result["match_ms"]["max"]:  # stereo pairs
        say(f"a pair: matching {milliseconds(result['match_ms'])}")
    say(f"a frame: depth {milliseconds(result['depth_ms'])}; map {milliseconds(result['integrate_ms'])}")
    say(cells_line(result))
    if not result["occupied"]:
        say(f"note: {_why_nothing(result, window)}")
    say(f"saved in {out}; look at it with: {command_line('picture', out, f'{out.stem}.png')}")


def _why_nothing(result: dict[str, Any], window: WindowConfig) -> str:
    """Return what to look at when a map ends without an occupied cell."""
    if window.centre is not None and not result["free"] + result["tentative"]:
        return "no cell is known; the camera never was in the box of window.centre and window.size"
    if result["tentative"]:
        tentative = thousands(result["tentative"])
        return f"no cell is occupied, but {tentative} are tentative; is --max-range large enough, map.prior too low?"
    return "no cell is occupied; is --max-range large enough?"
