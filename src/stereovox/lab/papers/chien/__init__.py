# SPDX-License-Identifier: Apache-2.0
"""The experiments of Chien 2020: what was measured, what the paper says, and the pictures."""
