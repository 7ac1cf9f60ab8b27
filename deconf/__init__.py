"""Deconfounded imitation learning: beliefs, methods, exact references.

Importing it sets torch to one thread, since the networks are small and more threads make them many times slower; call
`torch.set_num_threads` afterwards for networks of your own that are not.
"""

from deconfounded.deconf.core.nets import prepare_torch

prepare_torch()
