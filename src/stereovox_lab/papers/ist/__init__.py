# SPDX-License-Identifier: Apache-2.0
"""The parts of the experiments of IST 2019."""
