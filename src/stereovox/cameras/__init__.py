# SPDX-License-Identifier: Apache-2.0
"""Camera models, from pixel to ray, and the geometry of stereo pairs."""
