# SPDX-License-Identifier: Apache-2.0
"""Compare 2-D grids with a reference."""
