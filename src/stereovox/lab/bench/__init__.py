# SPDX-License-Identifier: Apache-2.0
"""How fast stereovox is beside other libraries."""
