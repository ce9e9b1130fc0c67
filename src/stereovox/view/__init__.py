# SPDX-License-Identifier: Apache-2.0
"""Pictures of maps, grids, calibrations and evaluations."""
