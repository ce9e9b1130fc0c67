# SPDX-License-Identifier: Apache-2.0
"""Accuracy of mapping libraries on the same recordings, by a fixed protocol (docs/benchmark.md)."""
