# SPDX-License-Identifier: Apache-2.0
"""Benchmarks: stereovox beside other libraries."""
