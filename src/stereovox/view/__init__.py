# SPDX-License-Identifier: Apache-2.0
"""Ways to look at a map."""
