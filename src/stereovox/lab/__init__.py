# SPDX-License-Identifier: Apache-2.0
"""The laboratory: papers, benchmarks and checks. Nothing of the product imports it."""
