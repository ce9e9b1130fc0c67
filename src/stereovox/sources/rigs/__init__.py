# SPDX-License-Identifier: Apache-2.0
"""Stereo pairs and rigs of several cameras."""
