"""Deconfounded imitation learning: beliefs, methods, exact references.

Importing networks sets torch to one thread (`core/layers.py`), since they are small and many times slower with more
threads; call `torch.set_num_threads` afterwards for large networks of your own.
"""
