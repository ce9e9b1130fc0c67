# SPDX-License-Identifier: Apache-2.0
"""Runs over whole recordings: a map, a floor, a trajectory."""
