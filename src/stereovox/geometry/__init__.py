# SPDX-License-Identifier: Apache-2.0
"""Rigid motions in 2-D and 3-D, and graphs of poses."""
