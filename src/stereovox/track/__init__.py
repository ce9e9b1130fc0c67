# SPDX-License-Identifier: Apache-2.0
"""Visual and depth odometry: camera poses estimated from the images themselves."""
