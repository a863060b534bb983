"""The other side of the real drivers of robot-hal: devices that a vendor's unmodified library takes for its own."""
