# SPDX-License-Identifier: Apache-2.0
"""Saved maps: reading, writing, locks."""
