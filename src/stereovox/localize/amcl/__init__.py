# SPDX-License-Identifier: Apache-2.0
"""Adaptive Monte Carlo localisation (Fox 2003; Thrun, Burgard and Fox 2005)."""
