# SPDX-License-Identifier: Apache-2.0
"""Queries for points, boxes and rays in a map."""
