"""Simulators of others with a hidden context, in which the truth about confounding is measured."""
