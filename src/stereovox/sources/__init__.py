# SPDX-License-Identifier: Apache-2.0
"""Layouts of recordings, live cameras, and the readers of files that they share."""
