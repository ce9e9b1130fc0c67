# SPDX-License-Identifier: Apache-2.0
"""Viewer: maps and recordings on a local page."""
