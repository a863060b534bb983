"""An emulator of a Franka: the vendor's own client library talks to it as to the arm."""
