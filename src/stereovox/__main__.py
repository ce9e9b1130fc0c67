# SPDX-License-Identifier: Apache-2.0
"""`python -m stereovox` is the command line."""

import sys

from stereovox.cli import main

if __name__ == "__main__":
    sys.exit(main())
