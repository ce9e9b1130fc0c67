# SPDX-License-Identifier: Apache-2.0
"""Loop closure in space: places that a camera saw again, and its way bent so that they are one."""
