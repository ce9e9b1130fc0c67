# SPDX-License-Identifier: Apache-2.0
"""Recordings and live cameras: one module per layout."""
