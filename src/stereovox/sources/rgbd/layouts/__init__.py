# SPDX-License-Identifier: Apache-2.0
"""Layouts of RGB-D recordings, one a module."""
