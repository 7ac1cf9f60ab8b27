"""Tasks of the suite under more or less noise, for spectrum.py: `noise:TiltedCartpoleProcess4`, `...Expert05`.

Process noise is that of every joint, times a factor; the expert's is its action noise. Bodies, thetas, rewards and the
experts' networks are the suite's own.
"""

from typing import Any

import mujoco

from deconfounded import envs

BASES = ("tilted_cartpole", "icy_road")
FACTORS = {"process": (0.25, 0.5, 1, 2, 4, 8), "expert": (0.25, 0.5, 2, 4, 8)}  # 1 is the same task in both


def title(base: str, kind: str, factor: float) -> str:
    """The class of a task's variant."""
    return f"{base}_{kind}".title().replace("_", "") + f"{factor:g}".replace(".", "")


def noisier(base: str, kind: str, factor: float) -> type[envs.MujocoTask]:
    """The task with so many times the noise of that kind."""
    task = envs.get(base)
    assert isinstance(task, envs.MujocoTask)
    changed: dict[str, Any] = {"expert_noise": factor * task.expert_noise}
    if kind == "process":
        noise = {joint: tuple(factor * std for std in stds) for joint, stds in task.process_noise.items()}
        changed = {"process_noise": noise}

    def spec(self: envs.MujocoTask) -> mujoco.MjSpec:
        """The suite's own model."""
        return task.spec()

    own = title(base, kind, factor)
    changed |= {"name": f"{base}_{kind}_{factor:g}".replace(".", "_"), "spec": spec, "__module__": __name__}
    return type(own, (type(task),), {**changed, "__doc__": f"{base} with {factor:g} times its {kind} noise."})


for _base in BASES:
    for _kind, _factors in FACTORS.items():
        for _factor in _factors:
            globals()[title(_base, _kind, _factor)] = noisier(_base, _kind, _factor)
