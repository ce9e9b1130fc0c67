# SPDX-License-Identifier: Apache-2.0
"""The viewer: maps and recordings on a local page."""
