"""What a rig may say under ``options:`` of its pad."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["Options"]


class Options(BaseModel):
    """Others are ignored: the same pad of a rig may also be driven by evdev, which has options of its own.

    With the default mapping a step of an axis is 5 to 8 mm or about 2 degrees, one of a shoulder button 3 to 10 mm.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    tty: str | None = None
    """The terminal, for example ``/dev/pts/3``; the program's own unless said."""
    mode: Literal["auto", "step"] = "auto"
    """``auto``: keys can be held where the terminal reports releases; ``step``: one step for each press everywhere."""
    step_s: float = Field(0.08, gt=0.0, le=0.08)
    """How long a step of an axis takes, s. The servo's watchdog ends one after 0.12 s, whatever
    happens here; what is left in between is for a loaded machine, which polls late."""
    dpad_share: float = Field(0.5, gt=0.0, le=1.0)
    """How far a step pushes the d-pad, share of its travel."""
    stick_share: float = Field(0.6, gt=0.0, le=1.0)
    """The same for the sticks."""
    button_s: float = Field(0.05, gt=0.0, le=0.08)
    """How long a step of a shoulder button takes, which has no half-way, s."""
