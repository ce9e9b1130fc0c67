# SPDX-License-Identifier: Apache-2.0
"""The parts of Valenti 2018's evaluation (chapter 8): recordings, three mappers, truth, scores and claims."""
