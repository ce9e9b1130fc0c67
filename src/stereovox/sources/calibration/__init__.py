# SPDX-License-Identifier: Apache-2.0
"""Camera calibrations in files of many kinds."""
