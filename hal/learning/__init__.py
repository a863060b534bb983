"""Tools for learning with a rig: episodes, policies, replay of recordings, and a Gymnasium environment."""
