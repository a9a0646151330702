"""Group level: registration of profiles, point-wise models, classification; pure functions."""
