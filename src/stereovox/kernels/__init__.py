# SPDX-License-Identifier: Apache-2.0
"""What compiled code needs: decorators, threads, the graphics card."""
