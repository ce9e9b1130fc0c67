# SPDX-License-Identifier: Apache-2.0
"""Which frames may change the map: validation, the gate, the frame history and health."""
