# SPDX-License-Identifier: Apache-2.0
"""What a process of `watched.Watched` does in a test: batch 1 hangs, 2 dies, the others are well."""

import os
import time
from collections import Counter

import frames as fuzz


def work(tell, number, since, seed, words, batch, frames, until):
    while batch < frames // fuzz.BATCH:
        number.value, since.value = 17, time.monotonic()
        if batch == 1:
            time.sleep(60)
        if batch == 2:
            os._exit(5)
        tell.send((fuzz.Tally(frames=Counter(Frame=1)), 1.0))
        batch += 1
