# SPDX-License-Identifier: Apache-2.0
"""Checks on simulated and corrupted recordings that are too long for tests."""
