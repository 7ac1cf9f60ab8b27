"""Deconfounded imitation learning: `envs`, `experts`, `deconf` and `benchmarks` under one name.

Each of the four is a folder at the top of the repository; the links here are for type checkers and editors. Importing
this package imports none of them, so that who wants the environments alone needs no more than these.
"""
