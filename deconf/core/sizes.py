"""How large networks are, by how much is observed."""

MANY, WIDE = 16, 128  # from so many observed numbers on, all methods' networks on control are so wide
SPACIOUS = 8  # dimensions of theta_hat there: with 4, one seed of three read it less well on ant_goal and the walker
