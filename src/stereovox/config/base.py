# SPDX-License-Identifier: Apache-2.0
"""What all sections of the settings have in common."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """A part of the settings: unknown names are errors, numbers are finite, values do not change."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
