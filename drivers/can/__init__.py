"""Arms on a CAN bus, through python-can."""
