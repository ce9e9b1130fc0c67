# SPDX-License-Identifier: Apache-2.0
"""Commands that correct, join or reduce maps."""
