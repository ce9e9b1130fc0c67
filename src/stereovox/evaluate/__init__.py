# SPDX-License-Identifier: Apache-2.0
"""How good is a map? Exact truth of simulated scenes, metrics, and a report."""
