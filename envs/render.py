"""Rendering of MuJoCo states without a screen: by EGL, else by OSMesa, else InputError."""

import importlib
import os
import subprocess
import sys
from functools import cache, partial
from typing import Any

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context
from numpy.typing import NDArray

from deconfounded.envs.streams import Array
from deconfounded.envs.support.errors import InputError
from deconfounded.envs.support.handles import Handle

BACKENDS = {"linux": ("egl", "osmesa"), "darwin": ("cgl", "glfw")}  # in this order
_PROBE = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"


@cache
def backend() -> str:
    """Name of the GL backend that works here: MUJOCO_GL if set, else of BACKENDS. Raises InputError if none does."""
    # A failed import leaves PyOpenGL on the wrong platform, so each is tried in a process of its own.
    selected = os.environ.get("MUJOCO_GL", "").strip().lower()  # as mujoco reads it
    names = (selected,) if selected else BACKENDS.get(sys.platform, ("glfw",))
    for name in names:
        environ = {**os.environ, "MUJOCO_GL": name}
        if subprocess.run([sys.executable, "-c", _PROBE], env=environ, capture_output=True).returncode == 0:
            return name
    remedy = "; install libegl1 or libosmesa6" * (sys.platform == "linux")
    raise InputError(f"no GL for pictures: tried {' and '.join(names)}{remedy}")


def _context(width: int, height: int) -> Any:
    """MuJoCo's GL context of the backend that works here."""
    name = backend()
    module = name if name in ("egl", "osmesa", "cgl") else "glfw"
    return importlib.import_module(f"mujoco.{module}").GLContext(width, height)


if not hasattr(gl_context, "GLContext"):  # MuJoCo was imported without GL, and others may draw with it too
    gl_context.GLContext = mujoco.GLContext = _context

_GL_PROCESSES: set[int] = set()  # that created a GL context: this process, and those that it was forked from


def _create(model: mujoco.MjModel) -> mujoco.Renderer:
    if _GL_PROCESSES - {os.getpid()}:  # the GL library would wait for threads of the parent process
        raise InputError("pictures cannot be made in a fork of a process that has made some; start it by `spawn`")
    _GL_PROCESSES.add(os.getpid())
    return mujoco.Renderer(model, height=240, width=320)


def _load_triton() -> None:
    """Import triton, if it is installed, before a GL library is loaded, or isolated from it."""
    # Mesa's software renderers and triton each contain an LLVM. Mesa's is visible to the whole process (RTLD_GLOBAL): a
    # triton that is loaded later binds to Mesa's and crashes; a triton that is loaded earlier has bound to its own.
    # torch imports triton with its first optimizer, which is too late for a process that renders, then trains. Where a
    # GL library is loaded already, RTLD_DEEPBIND makes triton search itself first; only there, as that also bypasses a
    # preloaded malloc. The import costs .1 s and 90 MB, once, and imports no torch.
    if "triton" in sys.modules:
        return
    deepbind = getattr(os, "RTLD_DEEPBIND", 0) if "OpenGL" in sys.modules else 0
    if deepbind:
        flags = sys.getdlopenflags()
        sys.setdlopenflags(flags | deepbind)
    try:
        importlib.import_module("triton")
    except ImportError:
        pass
    finally:
        if deepbind:
            sys.setdlopenflags(flags)


def _close(renderer: mujoco.Renderer) -> None:
    # Renderer.close frees buffers by number in the current context, which may be another renderer's: select its own.
    if renderer._gl_context is not None and renderer._mjr_context is not None:
        renderer._gl_context.make_current()
        renderer._mjr_context.free()
        renderer._mjr_context = None
    renderer.close()


def ribbon(spec: mujoco.MjSpec, name: str, left: Array, right: Array, grey: float) -> None:
    """Add a visual strip on the ground between two lines [K, 2], m."""
    k, i = len(left), np.arange(len(left) - 1)
    corners = np.pad(np.concatenate([left, right]), ((0, 0), (0, 1)), constant_values=0.002)
    faces = np.stack([i, i + k, i + 1, i + 1, i + k, i + k + 1], -1)
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert, mesh.userface = corners.ravel(), faces.ravel()
    look = {"contype": 0, "conaffinity": 0, "rgba": [grey, grey, grey, 1]}
    spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **look)


def sky(spec: mujoco.MjSpec) -> None:
    """Add a plain sky."""
    builtin, kind = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, mujoco.mjtTexture.mjTEXTURE_SKYBOX
    colours = {"rgb1": [0.9, 0.94, 1], "rgb2": [0.6, 0.72, 0.85]}
    spec.add_texture(name="sky", type=kind, builtin=builtin, width=32, height=192, **colours)


def chequer(spec: mujoco.MjSpec, material: str) -> None:
    """Give a material a dark chequered texture."""
    builtin, kind = mujoco.mjtBuiltin.mjBUILTIN_CHECKER, mujoco.mjtTexture.mjTEXTURE_2D
    colours = {"rgb1": [0.1, 0.2, 0.3], "rgb2": [0.2, 0.3, 0.4]}
    spec.add_texture(name=material, type=kind, builtin=builtin, width=64, height=64, **colours)
    spec.material(material).textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = material


def gravity_in_view(model: mujoco.MjModel) -> Array:
    """Gravity [3] as the camera `view` sees it: to the right, up, and towards the camera."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model.opt.gravity @ data.cam_xmat[model.camera("view").id].reshape(3, 3)


def level(model: mujoco.MjModel) -> None:
    """Roll the camera `view` until gravity points down in its picture, unless there is none across the view."""
    right, up, _ = gravity_in_view(model)
    if np.hypot(right, up) > 1e-6 * np.linalg.norm(model.opt.gravity):
        roll, quat = np.arctan2(right, -up) / 2, model.camera("view").quat
        mujoco.mju_mulQuat(quat, quat.copy(), np.array([np.cos(roll), 0.0, 0.0, np.sin(roll)]))


class MujocoRenderer:
    """Renderer of a model's states through its camera `view`. Raises InputError where no GL works."""

    def __init__(self, model: mujoco.MjModel) -> None:
        _load_triton()
        backend()  # before a renderer is begun, as it may fail
        gl_context.GLContext = _context
        self._model, self._data = model, mujoco.MjData(model)
        level(model)
        self._renderer = Handle(partial(_create, model), _close)
        self._renderer()

    def __call__(self, state: Array, action: Array) -> NDArray[np.uint8]:
        """State [S], of which the full physics state is drawn -> picture [H, W, 3]."""
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
        mujoco.mj_setState(self._model, self._data, state[: mujoco.mj_stateSize(self._model, kind)], kind)
        mujoco.mj_forward(self._model, self._data)
        renderer = self._renderer()
        renderer.update_scene(self._data, "view")
        return renderer.render()
