# SPDX-License-Identifier: Apache-2.0
"""Questions about places, boxes and rays in a map."""
