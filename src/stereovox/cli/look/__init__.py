# SPDX-License-Identifier: Apache-2.0
"""Commands that show a map or export it."""
