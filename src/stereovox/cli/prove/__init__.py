# SPDX-License-Identifier: Apache-2.0
"""Commands that compare maps with the truth."""
