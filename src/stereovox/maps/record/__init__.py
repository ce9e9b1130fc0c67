# SPDX-License-Identifier: Apache-2.0
"""What a map records about itself: its health, its history, the frames it keeps."""
