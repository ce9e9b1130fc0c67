# SPDX-License-Identifier: Apache-2.0
"""Commands for a first look: demo, simulate, info."""
