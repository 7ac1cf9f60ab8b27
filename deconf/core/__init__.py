"""Data, networks, beliefs, models and agents that several methods share."""
