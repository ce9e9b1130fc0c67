# SPDX-License-Identifier: Apache-2.0
"""Corrected poses: close loops, merge maps, rebuild a map from its recording."""
