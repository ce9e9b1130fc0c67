# SPDX-License-Identifier: Apache-2.0
"""Poses from files and streams."""
