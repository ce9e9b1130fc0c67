# SPDX-License-Identifier: Apache-2.0
"""From a stereo pair to a depth image (Valenti 2018, chapters 4 and 5)."""
