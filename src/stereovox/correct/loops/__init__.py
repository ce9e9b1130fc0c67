# SPDX-License-Identifier: Apache-2.0
"""Loop closure in space: finds revisited places, and corrects the trajectory so that they coincide."""
