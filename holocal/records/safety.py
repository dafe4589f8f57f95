"""``[safety]`` of a rig's file: what no run may exceed, whatever the devices could do."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, Field

from holocal.records.validate import validated

if TYPE_CHECKING:
    from holocal.records.rig import RigConfig


class SafetyTable(BaseModel):
    """The longest exposure of any frame, and how old an accepted calibration may be; None: no limit of this kind.

    There is no limit of the light's power, since nothing here can raise it: a light is switched on and off, no more.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)

    max_exposure_s: float | None = Field(default=None, gt=0.0, le=3600.0)
    max_calibration_age_days: float | None = Field(default=None, gt=0.0, le=36500.0)


class _File(BaseModel):
    """A rig's file as far as its safety goes."""

    model_config = ConfigDict(extra="ignore")

    safety: SafetyTable = SafetyTable()


def safety_of(config: RigConfig) -> SafetyTable:
    """Return the checked ``[safety]`` of a rig's file of any kind; its limits are None where there is no such table."""
    return validated(_File, config.tables, source=config.source).safety
