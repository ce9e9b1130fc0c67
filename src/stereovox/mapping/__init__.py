# SPDX-License-Identifier: Apache-2.0
"""What happens to a frame on its way into a map: checks, comparison, deadline, corrections."""
