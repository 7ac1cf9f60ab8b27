"""Deconfounded imitation learning: beliefs, methods, exact references.

The first network that is imported sets torch to one thread (`core/nets.py`), since the networks are small and more
threads make them many times slower; call `torch.set_num_threads` afterwards for networks of your own that are not.
"""
