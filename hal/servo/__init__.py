"""The servo: the only place where set-points are made. Pure: no clock, device or process inside.

``servo`` is one tick; ``watchdog`` decides whether the arm may move; ``joint``, ``cartesian`` and ``torque`` turn
commands into motions; ``envelope`` caps them to the session's terms; ``smoothing`` makes the next set-point and keeps
every limit; ``anchoring`` checks whether the device took the last one; ``controllers`` and ``compliance`` make torques
of it where a session has a controller; ``audit`` recomputes from what the driver was given whether limits were kept.
"""
