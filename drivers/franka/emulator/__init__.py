"""A program that stands in for a Franka: the vendor's own client library talks to it as it does to the arm."""
