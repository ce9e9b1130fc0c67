# SPDX-License-Identifier: Apache-2.0
"""The experiments told, one module each: what the paper says, what came out here, what holds."""
