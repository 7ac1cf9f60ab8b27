"""Models for stepping alone: without what changes no state, and, meanwhile, without MuJoCo's clock."""

import contextlib
import ctypes
from collections.abc import Iterator

import mujoco

FLAGS, ENABLED = mujoco.mjtDisableBit, mujoco.mjtEnableBit


def lean(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model whose states are those of `spec.compile()`, bit for bit; the specification is changed.

    Visual geoms, meshes and materials are discarded, and sensors of MuJoCo not evaluated. Nor are islands of
    constraints searched where there is one tree of bodies: it is one island then, in the order of its joints.
    """
    spec.compiler.discardvisual = True
    model = spec.compile()
    if model.ntree == 1 and not model.opt.enableflags & ENABLED.mjENBL_SLEEP.value:
        model.opt.disableflags |= FLAGS.mjDSBL_ISLAND.value
    if not model.nhistory and not model.nplugin:  # both may keep a sensor's past in the state
        model.opt.disableflags |= FLAGS.mjDSBL_SENSOR.value
    return model


def _clock() -> ctypes.c_void_p:
    """MuJoCo's pointer to the clock of its profiler; one that has no effect where the library does not export it."""
    try:
        return ctypes.c_void_p.in_dll(ctypes.CDLL(mujoco._functions.__file__), "mjcb_time")
    except (OSError, ValueError):
        return ctypes.c_void_p()


CLOCK = _clock()


@contextlib.contextmanager
def no_clock() -> Iterator[None]:
    """Meanwhile MuJoCo does not time its own stages (`MjData.timer`), which takes a third of a small model's step."""
    before, CLOCK.value = CLOCK.value, None
    try:
        yield
    finally:
        CLOCK.value = before
