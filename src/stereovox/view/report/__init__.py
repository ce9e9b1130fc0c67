# SPDX-License-Identifier: Apache-2.0
"""Reports: self-contained HTML pages."""
