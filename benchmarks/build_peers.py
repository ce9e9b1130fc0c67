# SPDX-License-Identifier: Apache-2.0
"""Build other mapping libraries for `stereovox bench`, each with a small adapter (benchmarks/peers/*.cpp).

    python benchmarks/build_peers.py FOLDER --out BUILT [--march x86-64-v3] [NAME ...]
    STEREOVOX_PEERS=BUILT stereovox bench RECORDING --peers octomap-cpp,bonxai,ufomap,wavemap-cpp

FOLDER holds checkouts of any of OctoMap/octomap, facontidavide/Bonxai, UnknownFreeOccupied/ufomap and ethz-asl/wavemap,
in folders of these names. Dependencies besides a compiler, on Debian: libeigen3-dev (Bonxai, wavemap),
libgoogle-glog-dev and libboost-dev (wavemap), liblz4-dev and libtbb-dev (UFOMap). None of their code becomes part of
stereovox.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ADAPTERS = Path(__file__).with_name("peers")
OPTIMISED = ("-O3", "-DNDEBUG", "-std=c++17", "-fPIC", "-w")
ERROR_LINES = 6
"""Most lines shown of a compiler error."""


@dataclass(frozen=True)
class Library:
    """A library to build: its adapter, the folder of its checkout, and the headers and sources in it (globs)."""

    adapter: str
    folder: str
    include: tuple[str, ...]
    sources: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    libraries: tuple[str, ...] = ()


LIBRARIES = {
    "octomap-cpp": Library(
        "octomap.cpp",
        "octomap",
        ("octomap/include",),
        (
            *(f"octomap/src/{name}.cpp" for name in ("Abstract*", "OcTree", "OcTreeNode", "Pointcloud", "ScanGraph")),
            "octomap/src/math/*.cpp",
        ),
    ),
    "bonxai": Library(
        "bonxai.cpp",
        "Bonxai",
        ("bonxai_core/include", "bonxai_map/include"),
        ("bonxai_map/src/probabilistic_map.cpp",),
    ),
    "ufomap": Library(
        "ufomap.cpp",
        "ufomap",
        ("ufomap/include",),
        ("ufomap/src/geometry/*.cpp", "ufomap/src/map/occupancy_map.cpp"),
        libraries=("-llz4", "-ltbb"),
    ),
    "wavemap-cpp": Library(
        "wavemap.cpp",
        "wavemap",
        ("library/cpp/include",),
        tuple(
            f"library/cpp/src/core/{name}.cc"
            for name in (
                "config/*",
                "integrator/integrator_base",
                "integrator/measurement_model/continuous_*",
                "integrator/projection_model/circular_projector",
                "integrator/projection_model/pinhole_camera_projector",
                "integrator/projection_model/spherical_projector",
                "integrator/projective/projective_integrator",
                "integrator/projective/coarse_to_fine/hashed_chunked_wavelet_integrator",
                "map/map_base",
                "map/hashed_chunked_wavelet_octree*",
                "utils/thread_pool",
            )
        ),
        options=("-DEIGEN_INITIALIZE_MATRICES_BY_NAN",),
        libraries=("-lglog",),
    ),
}
"""By name of the peer."""


class CannotBuildError(Exception):
    """A library is missing or its build failed; the text is for people."""


def main() -> int:
    """Build the requested libraries, or all; return the number of failures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="holds the libraries' checkouts")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(LIBRARIES)} (all of them)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where built libraries go")
    parser.add_argument("--march", default="native", help="processor to build for, as GCC names it (%(default)s)")
    parser.add_argument("--compiler", default=os.environ.get("CXX", "g++"), help="(%(default)s)")
    arguments = parser.parse_intermixed_args()
    unknown = [name for name in arguments.names if name not in LIBRARIES]
    if unknown:
        parser.error(f"unknown: {', '.join(unknown)}; known: {', '.join(LIBRARIES)}")
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--out {arguments.out}: {error.strerror}; name a folder that can be written")
    failed = 0
    for name in arguments.names or LIBRARIES:
        try:
            path = build(name, arguments.folder, arguments.out, arguments.march, arguments.compiler)
            print(f"{name}: {path}", flush=True)
        except CannotBuildError as why:
            failed += 1
            print(f"{name}: not built: {why}", file=sys.stderr, flush=True)
    print(f"\nSTEREOVOX_PEERS={shlex.quote(str(arguments.out.resolve()))} stereovox bench RECORDING --peers NAME,NAME")
    return failed


def build(name: str, folder: Path, out: Path, march: str = "native", compiler: str = "g++") -> Path:
    """Compile library `name`, whose checkout lies in `folder`, and its adapter into one file; return its path."""
    library = LIBRARIES[name]
    checkout = _checkout(folder, library.folder)
    sources = [path for pattern in library.sources for path in sorted(checkout.glob(pattern))]
    if not sources:
        raise CannotBuildError(f"{checkout} has no {library.sources[0]}; is it the library's newest main branch?")
    options = [*OPTIMISED, f"-march={march}", *library.options, f"-I{ADAPTERS}"]
    options += [f"-I{checkout / path}" for path in library.include]
    options += [f"-I{path}" for path in ("/usr/include/eigen3",) if Path(path).is_dir()]
    target = out / f"{name}.so"
    with tempfile.TemporaryDirectory(prefix="stereovox-peers-") as scratch:
        objects = []
        for number, source in enumerate([ADAPTERS / library.adapter, *sources]):
            objects.append(str(Path(scratch) / f"{number}.o"))
            _run([compiler, *options, "-c", str(source), "-o", objects[-1]])
        made = Path(scratch) / target.name
        link = ["-shared", "-Wl,-z,defs", "-pthread", *library.libraries]
        _run([compiler, *objects, *link, "-o", str(made)])
        target.write_bytes(made.read_bytes())
    return target


def _checkout(folder: Path, name: str) -> Path:
    """Return the folder of that name, however its letters are written."""
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.is_dir() and path.name.lower() == name.lower():
            return path
    raise CannotBuildError(f"no {name} in {folder}; clone it there")


def _run(words: list[str]) -> None:
    try:
        done = subprocess.run(words, capture_output=True, text=True)
    except OSError as error:
        raise CannotBuildError(
            f"{words[0]}: {error.strerror}; install a C++ compiler, or name one: --compiler"
        ) from None
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if "error" in line or "undefined" in line]
        raise CannotBuildError("\n  ".join([f"{words[0]} failed:", *(said or done.stderr.splitlines())[:ERROR_LINES]]))


if __name__ == "__main__":
    sys.exit(main())
