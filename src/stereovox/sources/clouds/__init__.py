# SPDX-License-Identifier: Apache-2.0
"""Recordings of lidars: clouds in folders, in KITTI's recordings and in bags, and 2-D scans as clouds."""
