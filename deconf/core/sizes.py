"""Sizes of networks, by the width of observations."""

LARGE_OBSERVATION, WIDE = 16, 128  # for observations of so many numbers or more, networks on control have this width
LARGE_LATENT = 8  # dimensions of theta_hat there; with 4, one seed of three was worse on ant_goal and slippery_walker
