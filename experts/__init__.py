"""Policies that see theta, and the trials they make."""
