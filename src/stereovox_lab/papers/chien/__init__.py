# SPDX-License-Identifier: Apache-2.0
"""Experiments of Chien 2020, one per module: measurement, chapter and pictures."""
