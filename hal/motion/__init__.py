"""Planning of whole motions: straight lines of the tcp, rounded corners, waypoints.

``lines`` has the way of the tcp, ``planning`` turns it into joint positions and checks it before anything moves. The
servo follows the result and times it (:mod:`hal.servo.planned`).
"""
