# SPDX-License-Identifier: Apache-2.0
"""Reports: single pages of HTML without any outside file."""
