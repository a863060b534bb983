"""The servo: the only place where set-points are made. Pure: no clock, device or process inside.

``servo`` is one tick; ``watchdog`` says whether the arm may move, ``motions``, ``cartesian`` and ``path`` where to,
``envelope`` how fast at most, ``smoothing`` and ``limits`` what the next set-point is, ``anchoring`` whether the device
took the last one, ``torque`` and ``torque_bounds`` drive an arm by torques, and ``audit`` recomputes from what the
driver was given whether the limits were kept.
"""

from .servo import Servo, ServoReport

__all__ = ["Servo", "ServoReport"]
