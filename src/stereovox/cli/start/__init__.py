# SPDX-License-Identifier: Apache-2.0
"""Commands to start with: demo, simulate, info."""
