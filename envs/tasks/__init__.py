"""The suite's tasks, a file each, and the bodies that several tasks share (cartpole.py, puck.py).

A new task is a file here, an MJCF in assets/ and its name below. A task of your own can stay in your folder.
"""

import importlib

from deconfounded.envs.registry import register

SUITE = (
    *("bandit", "tilted_cartpole", "slippery_cartpole", "heavy_payload", "icy_road", "slippery_walker", "hidden_goal"),
    *("forked_path", "rolling_deck", "icy_stop", "weak_thruster", "dragged_sled", "cheetah_speed", "ant_goal"),
    *("curling", "swapped_lander", "windy_drone"),
)
# Where the exact policy succeeds, and learners without theta less: docs/hard.md; some certificates are yet to be made.
HARD = ("gusty_drone", "patchy_road", "loaded_arm", "loaded_drone", "lame_ant", "drifting_raft")

for _name in (*SUITE, *HARD):  # a task's class has its file's name, in camel case
    register(getattr(importlib.import_module(f"{__name__}.{_name}"), _name.title().replace("_", "")))
