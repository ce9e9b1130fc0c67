# SPDX-License-Identifier: Apache-2.0
"""Laboratory: papers, benchmarks, checks and the demo. Only the command line imports it."""
