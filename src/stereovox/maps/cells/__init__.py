# SPDX-License-Identifier: Apache-2.0
"""The numbers in a map's cells, and the pools that hold them."""
