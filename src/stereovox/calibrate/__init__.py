# SPDX-License-Identifier: Apache-2.0
"""Find out from recordings what a camera measures wrongly, how noisy it is, and how it sits beside a tracker."""
