# SPDX-License-Identifier: Apache-2.0
"""Camera models: how a pixel becomes a ray, and how cameras stand to each other."""
