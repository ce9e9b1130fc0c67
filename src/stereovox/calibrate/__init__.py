# SPDX-License-Identifier: Apache-2.0
"""Calibration from recordings: depth errors and noise of a camera, stereo lenses, and a camera's mount on a tracker."""
