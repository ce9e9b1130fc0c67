# SPDX-License-Identifier: Apache-2.0
"""Cell values of a map, and the pools that hold them."""
