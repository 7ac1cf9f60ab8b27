"""Gymnasium's MuJoCo bodies, read from the installed package."""

from importlib.resources import files

import mujoco


def load(name: str, timestep: float) -> mujoco.MjSpec:
    """Load a body, such as half_cheetah or ant, with every element named and without textures; timestep in s."""
    spec = mujoco.MjSpec.from_file(str(files("gymnasium") / "envs" / "mujoco" / "assets" / f"{name}.xml"))
    spec.option.timestep = timestep
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in spec.textures:
        spec.delete(texture)
    for i, body in enumerate(body for body in spec.bodies if not body.name):
        body.name = f"foot_{i + 1}"
    for actuator in spec.actuators:
        actuator.name = actuator.target
    for light in spec.lights:
        light.name = "sun"
    return spec
