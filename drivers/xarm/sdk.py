"""What this driver uses of xarm-python-sdk, which prints its version when it is imported."""

from __future__ import annotations

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from xarm.core.config.x_code import ControllerErrorCodeMap, ControllerWarnCodeMap, GripperErrorCodeMap
    from xarm.core.config.x_config import XCONF
    from xarm.core.utils.log import logger, origin_logger
    from xarm.wrapper import XArmAPI

__all__ = [
    "XCONF",
    "ControllerErrorCodeMap",
    "ControllerWarnCodeMap",
    "GripperErrorCodeMap",
    "XArmAPI",
    "logger",
    "origin_logger",
]
