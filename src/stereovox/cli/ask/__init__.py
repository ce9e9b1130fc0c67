# SPDX-License-Identifier: Apache-2.0
"""Commands that answer a question about a map."""
