# SPDX-License-Identifier: Apache-2.0
"""Matchers of others: OpenCV's semi-global matching (Hirschmueller 2008) and blocks, and a user's ONNX network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import StereoConfig
from stereovox.depth.stereo import _disparity
from stereovox.errors import ConfigError, FrameRefused, MissingExtra

COUNTS = 16
"""OpenCV counts disparities in sixteenths of a pixel."""
ROUNDED = -1 / 32
"""OpenCV rounds up: on planes all its matchers give 0.03 px too much."""
LOCKING = 0.62
"""Its semi-global matching pulls fractions to whole pixels: 0.5 (2 f)^0.62 restores their uniform distribution."""
PREFILTER = 63
"""Cap of the gradients along a row."""
MAX_COST = 32767
"""Largest cost: OpenCV's semi-global matching adds costs in 16 bits."""


class _OpenCv:
    lag_rows = 0.0
    locking = 1.0

    def __init__(self, config: StereoConfig) -> None:
        self._config = config
        self._matcher = self._make(config)
        self._fractions = _fractions(self.locking if config.unlock else 1.0)

    def __call__(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the disparity of the left image, see `Matcher`."""
        margin = self._config.disparities  # OpenCV leaves this many columns at the left without a value
        wider = [np.pad(image, ((0, 0), (margin, 0)), mode="edge") for image in (left, right)]
        with _threads(self._config.threads):
            raw = self._compute(*wider)[:, margin:]
        out = np.empty(raw.shape, np.float32)
        _disparity.pixels(raw, self._fractions, np.float32(self.lag_rows), out)
        return out

    def _compute(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.int16]:
        return self._matcher.compute(left, right)

    def _make(self, config: StereoConfig) -> Any:
        raise NotImplementedError


class _SemiGlobal(_OpenCv):
    mode = ""
    locking = LOCKING

    def _make(self, config: StereoConfig) -> Any:
        import cv2

        window = config.block_size**2
        if (config.p2 + PREFILTER) * window > MAX_COST:
            raise ConfigError(
                f"stereo.block_size {config.block_size} with p2 {config.p2:g}: too large, OpenCV's costs overflow; use "
                "less, or stereo.method=block"
            )
        return cv2.StereoSGBM.create(
            numDisparities=config.disparities, blockSize=config.block_size,
            P1=round(config.p1 * window), P2=round(config.p2 * window),
            disp12MaxDiff=_left_right(config), preFilterCap=PREFILTER, uniquenessRatio=config.uniqueness,
            speckleWindowSize=config.speckle_size, speckleRange=max(1, round(config.speckle_range)),
            mode=getattr(cv2, f"STEREO_SGBM_MODE_{self.mode}"),
        )  # fmt: skip


class ThreeWay(_SemiGlobal):
    """Three paths: from the left, from the right, and from above or below.

    Its single vertical path delays disparities: a slanted plane comes out `lag_rows` rows late. This is corrected.
    """

    mode = "SGBM_3WAY"
    lag_rows = 0.35

    def _compute(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.int16]:
        if not self._config.from_below:
            return super()._compute(left, right)
        turned = [np.ascontiguousarray(image[::-1]) for image in (left, right)]
        return super()._compute(*turned)[::-1]

    def __init__(self, config: StereoConfig) -> None:
        super().__init__(config)
        self.lag_rows = -self.lag_rows if config.from_below else self.lag_rows


class EightWay(_SemiGlobal):
    """Eight paths: slow, and memory for all costs."""

    mode = "HH"


class FourWay(_SemiGlobal):
    """Four paths."""

    mode = "HH4"


class Block(_OpenCv):
    """Block matching: fast, but without values in areas without texture. Windows are at least 5 pixels wide."""

    def _make(self, config: StereoConfig) -> Any:
        import cv2

        matcher = cv2.StereoBM.create(config.disparities, max(5, config.block_size))
        matcher.setUniquenessRatio(config.uniqueness)
        matcher.setDisp12MaxDiff(_left_right(config))
        matcher.setSpeckleWindowSize(config.speckle_size)
        matcher.setSpeckleRange(max(1, round(config.speckle_range * COUNTS)))  # in raw counts, unlike SGBM
        return matcher

    def _compute(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.int16]:
        if min(left.shape) <= max(5, self._config.block_size):
            raise FrameRefused("bad_shape", f"images of {left.shape}: smaller than stereo.block_size; use less")
        return super()._compute(left, right)


def _fractions(locking: float) -> NDArray[np.float32]:
    """Return the value of the 16 fractions of a pixel; from a half on they count from the next whole pixel."""
    counts = np.arange(COUNTS) / COUNTS
    nearest = np.round(counts)
    off = counts - nearest
    return (nearest + np.sign(off) * 0.5 * (2 * np.abs(off)) ** locking + ROUNDED).astype(np.float32)


def _left_right(config: StereoConfig) -> int:
    return max(1, round(config.left_right)) if config.left_right else config.disparities  # SGBM turns less into 1


@contextmanager
def _threads(wanted: int) -> Iterator[None]:
    """Set the number of OpenCV's threads, and restore it afterwards."""
    import cv2

    before = cv2.getNumThreads()
    if wanted == before:
        yield
        return
    cv2.setNumThreads(wanted)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


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
