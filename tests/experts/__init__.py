"""Tests of experts/."""
