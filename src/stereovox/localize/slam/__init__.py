# SPDX-License-Identifier: Apache-2.0
"""Simultaneous localisation and mapping from a 2-D lidar."""
