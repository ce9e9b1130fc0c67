# SPDX-License-Identifier: Apache-2.0
"""Pictures for `stereovox reproduce`: ours beside what a paper shows. All are PNG, returned as bytes."""
