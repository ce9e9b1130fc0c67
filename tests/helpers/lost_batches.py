# SPDX-License-Identifier: Apache-2.0
"""What a process of `watched.Watched` does batch 1 waits forever, 2 dies, 4 works forever, others end well."""

import os
import time
from collections import Counter

import frames as fuzz


def work(tell, number, since, seed, words, batch, frames, until):
    while batch < frames // fuzz.BATCH:
        number.value, since[:] = 17, (time.monotonic(), time.process_time())
        if batch == 1:
            time.sleep(60)
        if batch == 2:
            os._exit(5)
        while batch == 4:
            pass
        tell.send((fuzz.Tally(frames=Counter(Frame=1)), 1.0))
        batch += 1
