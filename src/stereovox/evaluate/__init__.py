# SPDX-License-Identifier: Apache-2.0
"""Evaluation of maps and trajectories: ground truth, metrics and scores, in numbers only."""
