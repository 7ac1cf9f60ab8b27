"""Tests of deconf/."""
