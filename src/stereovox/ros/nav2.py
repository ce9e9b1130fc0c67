# SPDX-License-Identifier: Apache-2.0
"""Launch file and parameters for Nav2 to plan in a live map."""

from __future__ import annotations

import os
from importlib.resources import files
from pathlib import Path
from typing import Any

from stereovox.errors import StereovoxError
from stereovox.files.safe_io import check_local, read_text, replacing, yaml_value

OURS, LAUNCH, RESULT = "nav2.yaml", "nav2.launch.py", "nav2_params.yaml"
"""Our parameters, the launch file, and the file that is written for Nav2."""
COPIED = (LAUNCH, "stereovox.rviz", "foxglove.json")
THEIRS = Path("share/nav2_bringup/params/nav2_params.yaml")


def write_nav2(folder: str | Path, params: str | Path | None = None) -> list[Path]:
    """Write launch file, parameters and displays for Nav2.

    `nav2_params.yaml` is a whole file of Nav2's parameters, overridden by ours: the map as static layer, obstacles and
    free rays as observation sources, and the Collision Monitor's source.

    Args:
        folder: The target folder, created if missing. Older files of these names are replaced.
        params: The `nav2_params.yaml` to override; None: that of the sourced distribution's nav2_bringup.

    Returns:
        The files.

    Raises:
        StereovoxError: The file is missing or holds no parameters, or the folder cannot be written.
    """
    import yaml

    base = Path(params) if params is not None else _installed()
    merged = laid_over(_read(base), overlay())
    written = {RESULT: yaml.safe_dump(merged, sort_keys=False).encode()}
    written |= {name: _shared(name) for name in COPIED}
    paths = [Path(folder) / name for name in written]
    check_local(folder)
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StereovoxError(f"{folder}: cannot be created ({error.strerror}); choose another folder") from None
    for path, data in zip(paths, written.values(), strict=True):
        with replacing(path, StereovoxError) as file:
            file.write(data)
    return paths


def overlay() -> dict[str, Any]:
    """Return our parameters, by node."""
    return yaml_value(_shared(OURS))


def laid_over(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Return `base` overridden by the values of `over`, also in nested tables; lists are replaced as a whole."""
    merged = dict(base)
    for name, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(name), dict)
        merged[name] = laid_over(merged[name], value) if both else value
    return merged


def _shared(name: str) -> bytes:
    return (files("stereovox.ros") / "share" / name).read_bytes()


def _installed() -> Path:
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(":")):
        if (path := Path(prefix) / THEIRS).is_file():
            return path
    raise StereovoxError(
        "Nav2's parameters were not found; source a distribution with nav2_bringup, or give --nav2-params FILE.yaml"
    )


def _read(path: Path) -> dict[str, Any]:
    try:
        found = yaml_value(read_text(path))
    except OSError as error:
        raise StereovoxError(f"{path}: cannot be read ({error.strerror}); give a nav2_params.yaml") from None
    except ValueError as error:
        raise StereovoxError(f"{path}: is not YAML ({error}); give a nav2_params.yaml") from None
    if not isinstance(found, dict) or not any(isinstance(one, dict) for one in found.values()):
        raise StereovoxError(f"{path}: holds no parameters of nodes; give a nav2_params.yaml")
    return found
