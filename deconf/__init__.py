"""Deconfounded imitation learning: beliefs, methods, exact references."""
