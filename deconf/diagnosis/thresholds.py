"""Thresholds of the diagnosis: everything that a verdict compares a figure with."""

NEGLIGIBLE, NO_EVIDENCE = 0.1, 0.01  # nats a step: of memory and of latents, of the dynamics
SHARED = 0.5  # of what a latent makes a policy do that is to last through exploration too
DIFFERS = 0.03  # nats a step of evidence, in exploration too, from which on dynamics are said to differ
UNUSED = 0.25  # share by which a latent from the dynamics may explain more than a memory, which could know as much
MISFIT = 0.2  # nats a step by which a memory may make a clone worse
GOOD, SMALL_GAP, NO_LOSS = 0.8, 0.15, 0.97  # scores
SMALL_COST = 0.25  # a loss that the headline calls small, since it is as large as what splits differ by
STAKES = 1.5  # times chance
TRAIT_STAKES, TRAIT_SHARE = 3.0, 0.1  # times chance; of a memory's gain, for a goal that the dynamics do not tell
MIN_MODEL_LENGTH = 0.5  # of episodes in rollouts, over the data's, from which on it is believed that nothing is lost
MAX_MODEL_DEVIATION = 4.0  # deviation of rollouts from the data, up to which the absence of stakes is believed
