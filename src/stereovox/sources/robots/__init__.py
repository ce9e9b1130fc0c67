# SPDX-License-Identifier: Apache-2.0
"""Recordings of ground robots: scans, depth images and odometry."""
