# SPDX-License-Identifier: Apache-2.0
"""Compare trajectories with the truth."""
