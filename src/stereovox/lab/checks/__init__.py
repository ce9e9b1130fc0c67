# SPDX-License-Identifier: Apache-2.0
"""Checks on simulated and spoilt recordings that are too long for tests."""
