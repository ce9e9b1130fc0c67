# SPDX-License-Identifier: Apache-2.0
"""Commands that run on a robot."""
