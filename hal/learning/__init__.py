"""What learning needs around a rig: episodes, policies, replay of recordings, and a Gymnasium environment."""
