"""Gamepads behind the public class: models as data, from event codes to named controls, and which pad drives."""
