# SPDX-License-Identifier: Apache-2.0
"""Recordings of depth cameras as folders of images: one file a layout, and what they share."""
