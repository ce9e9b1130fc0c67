# SPDX-License-Identifier: Apache-2.0
"""A user's stereo network in an ONNX file: two images in, a disparity out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import StereoConfig
from stereovox.errors import ConfigError, MissingExtra


class Network:
    """Runs the network in `stereo.model` on the CPU.

    Its inputs: the left image, then the right, (1, C, H, W) with C 1 or 3 (grey three times), float32 0 to 255, or
    uint8. Any scaling must be part of the network. If H and W are fixed, images are put in the upper left corner
    and cut or padded with their border; if free, padded to multiples of 32. Its first output: the left image's
    disparity in pixels, with H and W last. Negative, infinite or NaN values and those above `disparities` are dropped.
    """

    def __init__(self, config: StereoConfig) -> None:
        """Raises ConfigError if the file is missing or not such a network, MissingExtra without onnxruntime."""
        if config.model is None:
            raise ConfigError("stereo.method 'onnx' needs a network: set stereo.model to an .onnx file")
        self._path, self._most = config.model, config.disparities
        self._session = _session(config.model, config.threads)
        self._inputs = self._session.get_inputs()
        if len(self._inputs) != 2 or any(len(one.shape) != 4 for one in self._inputs):
            shapes = [one.shape for one in self._inputs]
            raise ConfigError(f"{config.model}: takes {shapes}; a stereo network takes two images (1, C, H, W)")

    def __call__(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the disparity of the left image, see `Matcher`."""
        images = (left, right)
        feed = {one.name: _fitted(image, one) for one, image in zip(self._inputs, images, strict=True)}
        out = np.asarray(self._session.run(None, feed)[0], np.float32)
        height, width = left.shape
        size = next(iter(feed.values())).shape[2:]
        if out.shape[-2:] != size or out.size != size[0] * size[1]:
            raise ConfigError(
                f"{self._path}: gives {out.shape} for images {size}; it must give a disparity of their size"
            )
        full = np.full(left.shape, np.nan, np.float32)
        part = out.reshape(size)[:height, :width]
        full[: part.shape[0], : part.shape[1]] = np.where((part >= 0) & (part <= self._most), part, np.nan)
        return full


def _session(path: str, threads: int) -> Any:
    if not Path(path).is_file():
        raise ConfigError(f"stereo.model {path}: no such file")
    try:
        import onnxruntime
    except ImportError:
        raise MissingExtra("onnxruntime", "onnx") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    try:
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its exception types differ between versions
        raise ConfigError(f"{path}: not an ONNX network ({str(error).splitlines()[0]})") from None


def _fitted(image: NDArray[np.uint8], wanted: Any) -> NDArray[np.generic]:
    sizes = [
        size if isinstance(size, int) else -(-have // 32) * 32
        for size, have in zip(wanted.shape[2:], image.shape, strict=True)
    ]
    image = image[: sizes[0], : sizes[1]]
    rest = [(0, size - have) for size, have in zip(sizes, image.shape, strict=True)]
    channels = wanted.shape[1] if isinstance(wanted.shape[1], int) else 3
    full = np.broadcast_to(np.pad(image, rest, mode="edge"), (1, channels, *sizes))
    return np.ascontiguousarray(full, np.uint8 if "uint8" in wanted.type else np.float32)
