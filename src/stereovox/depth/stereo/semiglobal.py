# SPDX-License-Identifier: Apache-2.0
"""Semi-global matching (Hirschmueller 2008) along three paths in 8 bits, by gradient, grey value and census."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from stereovox.config import StereoConfig
from stereovox.depth.stereo import _disparity, _semiglobal
from stereovox.depth.stereo._semiglobal import BLOCK, MARGIN, MAX_COST, PLANES, RIM, Settings, StripScratch
from stereovox.errors import ConfigError
from stereovox.kernels.threads import Scratch, in_shards, shards

Image = NDArray[np.uint8]
COUNTS = 16
"""Disparities are counted in sixteenths of a pixel, as in OpenCV, so that its speckle filter accepts them."""
LOCKING = 0.7
"""Parabolas through the costs pull fractions to whole pixels: 0.5 (2 f)^0.7 spreads them."""
LAG_ROWS = 0.35
"""The single vertical path delays disparities: a slanted plane comes out this many rows late."""
STRIP, WARM = 90, 16
"""Approximate rows of a strip, and rows above it where its downward path starts. Strips do not depend on threads."""
PENALTIES = 0.75
"""`p1` and `p2` are meant for costs of up to 200 (OpenCV's); these are MAX_COST at most."""
EDGE = 16
"""Grey step between neighbours above which `p2` falls with the step: surfaces end at grey edges (Hirschmueller
2008, Eq 13). Three standard deviations of such a step if the image has noise of 4."""
UNIQUE = 2 / 3
"""Share of `uniqueness` that is required: the census differs in some bits even for correct matches."""


class Census:
    """Own matcher: three paths, costs of Birchfield and Tomasi on gradients and grey values, and of a census.

    It errs less than OpenCV's along three paths in 0.6 to 0.7 of the time, except if one eye is a row lower
    (docs/stereo.md). Several threads may use it at the same time.
    """

    def __init__(self, config: StereoConfig) -> None:
        """Raises ConfigError if a window is so large that its sum of costs would overflow."""
        if config.block_size**2 * MAX_COST > np.iinfo(np.uint16).max:
            raise ConfigError(
                f"stereo.block_size {config.block_size}: too large for method={config.method}, its costs overflow; use "
                "19 or less, or stereo.method=block"
            )
        self._config = config
        self._fractions = _fractions(LOCKING if config.unlock else 1.0)
        self._settings = _settings(config)
        self._scratch: tuple[int, Scratch[StripScratch]] | None = None
        self.lag_rows = -LAG_ROWS if config.from_below else LAG_ROWS

    def __call__(self, left: Image, right: Image) -> NDArray[np.float32]:
        """Return the disparity of the left image, see `Matcher`."""
        config = self._config
        if config.from_below:
            raw = np.ascontiguousarray(self._raw(left[::-1], right[::-1])[::-1])
        else:
            raw = self._raw(left, right)
        if config.speckle_size:
            import cv2

            steps = max(1, round(config.speckle_range)) * COUNTS
            cv2.filterSpeckles(raw, int(_semiglobal.NONE), config.speckle_size, steps)
        out = np.empty(raw.shape, np.float32)
        _disparity.pixels(raw, self._fractions, np.float32(self.lag_rows), out)
        return out

    def _raw(self, left: Image, right: Image) -> NDArray[np.int16]:
        """Return the disparities (h, w) in 1/16 px, negative: none. Several threads match strips at once."""
        height, width = left.shape
        planes = self._described(left, 0, 1), self._described(right[:, ::-1], _whole(self._config.disparities), -1)
        raw = np.empty((height, width), np.int16)
        count, strips = max(1, round(height / STRIP)), self._strips(width)

        def match(part: slice, scratch: StripScratch) -> None:
            for strip in range(part.start, part.stop):
                first, end = height * strip // count, height * (strip + 1) // count
                _semiglobal.match(*planes, max(0, first - WARM), first, end, self._settings, scratch, raw)

        in_shards(lambda part: strips.lend(partial(match, part)), _parts(count, self._config.threads))
        return raw

    def _described(self, image: Image, beyond: int, sign: int) -> Image:
        """Return an image's descriptors (PLANES, h, w + beyond); its edge is repeated beyond the last column."""
        import cv2

        height, width = image.shape
        wide = cv2.copyMakeBorder(
            np.ascontiguousarray(image), RIM, RIM, RIM, RIM + beyond, cv2.BORDER_REPLICATE
        )  # fmt: skip
        soft, planes = np.empty_like(wide), np.empty((PLANES, height, width + beyond), np.uint8)

        def soften(rows: slice) -> None:
            _semiglobal.soften(wide, rows.start, rows.stop, soft)

        def describe(rows: slice) -> None:
            line = np.empty(width + beyond + 2, np.uint8)
            _semiglobal.describe(wide, soft, rows.start, rows.stop, sign, line, planes)

        in_shards(soften, shards(len(wide), self._config.threads))
        in_shards(describe, shards(height, self._config.threads))
        return planes

    def _strips(self, width: int) -> Scratch[StripScratch]:
        """Return the memory for strips of images of this width; memory for another width is released."""
        kept = self._scratch
        if kept is None or kept[0] != width:
            n = _whole(self._config.disparities)
            self._scratch = kept = width, Scratch(partial(_strip_scratch, self._settings, width, n))
        return kept[1]


def _whole(disparities: int) -> int:
    """Return the number of disparities in whole blocks."""
    return -(-disparities // BLOCK) * BLOCK


def _settings(config: StereoConfig) -> Settings:
    """Return the settings as integers, with costs scaled down if path costs would not fit into 8 bits."""
    p1, p2 = PENALTIES * config.p1, PENALTIES * config.p2
    scale = min(1.0, (254 - 2) / (MAX_COST + p1 + p2))  # 2: both are rounded
    most = max(1, round(config.left_right)) if config.left_right else -1  # its resolution is no finer than half a pixel
    return Settings(
        radius=config.block_size // 2,
        p1=round(scale * p1),
        jumps=_jumps(round(scale * p1), max(1, round(scale * p2))),
        unique=round(UNIQUE * config.uniqueness),
        left_right=most,
        share=int(65536 * scale / config.block_size**2),
        disparities=config.disparities,
    )


def _jumps(p1: int, p2: int) -> NDArray[np.uint8]:
    """Return `p2` for each step of grey (256,), see EDGE; never less than `p1`."""
    steps = np.maximum(np.arange(256), EDGE)
    return np.maximum(p2 * EDGE // steps, p1).astype(np.uint8)


def _strip_scratch(settings: Settings, width: int, n: int) -> StripScratch:
    across, down = (np.full((2, width, MARGIN + n + MARGIN), 255 - settings.p1, np.uint8) for _ in range(2))
    return StripScratch(
        rows=np.empty((2 * settings.radius + 2, width, n), np.uint8),
        sums=np.empty((width, n), np.uint16),
        window=np.empty(n, np.uint16),
        costs=np.empty((width, n), np.uint8),
        across=across,
        down=down,
        lows=np.empty(width, np.uint8),
        total=np.empty(n, np.uint16),
        numbers=np.arange(n, dtype=np.uint16),
        rival=np.empty(width + n, np.uint16),
        owner=np.empty(width + n, np.uint16),
    )


def _parts(count: int, threads: int) -> list[slice]:
    """Return the strips of each thread; a thread without a strip is left out."""
    threads = min(threads, count)
    return [slice(count * i // threads, count * (i + 1) // threads) for i in range(threads)]


def _fractions(locking: float) -> NDArray[np.float32]:
    """Return the value of the 16 fractions of a pixel; from a half on they count from the next whole pixel."""
    counts = np.arange(COUNTS) / COUNTS
    nearest = np.round(counts)
    off = counts - nearest
    return (nearest + np.sign(off) * 0.5 * (2 * np.abs(off)) ** locking).astype(np.float32)
