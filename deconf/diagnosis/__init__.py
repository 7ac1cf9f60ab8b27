"""Diagnosis of confounding, from expert trials and exploration alone."""
