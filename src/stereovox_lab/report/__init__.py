# SPDX-License-Identifier: Apache-2.0
"""Reports of the laboratory as HTML pages."""
