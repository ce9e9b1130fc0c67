# SPDX-License-Identifier: Apache-2.0
"""The layouts of KITTI: raw, odometry, tracking and stereo 2015."""
