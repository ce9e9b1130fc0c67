# SPDX-License-Identifier: Apache-2.0
"""Benchmarks: stereovox next to other libraries."""
