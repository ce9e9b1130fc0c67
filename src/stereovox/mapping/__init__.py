# SPDX-License-Identifier: Apache-2.0
"""What happens to a frame before it enters a map: checks, comparison, deadline, corrections."""
