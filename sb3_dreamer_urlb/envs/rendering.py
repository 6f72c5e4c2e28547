"""Which OpenGL backend MuJoCo draws with, settled before the first frame.

dm_control reads ``MUJOCO_GL`` once, on import; where it is unset it takes GLFW, which on a machine without a display
fails only at the first frame, with an error that names no cause. And whatever it takes it loads at once, so that without
an OpenGL library not even the physics can be imported. So everything in this package that needs dm_control calls
:func:`load_physics` first, which imports it without any backend; :func:`load_renderer` chooses one when it is needed.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import sys
import warnings
from typing import Any

from sb3_dreamer_urlb.before_opengl import load_triton

_INSTALL_HINT = (
    "Install EGL (`apt-get install libegl1 libopengl0 libgl1-mesa-dri`) or OSMesa (`apt-get install libosmesa6`); "
    "no display and no GPU are needed."
)
_EGL_PLATFORM_DEVICE = 0x313F  # EGL_PLATFORM_DEVICE_EXT of the extension EGL_EXT_platform_device
_MAX_EGL_DEVICES = 10  # as many as dm_control asks for

_rendering_pid: int | None = None


class RenderingBackendError(RuntimeError):
    """No OpenGL backend can draw in this process; the message says what to install or to set."""


def load_physics() -> None:
    """Import dm_control without OpenGL: no library is loaded and none is needed, whatever ``MUJOCO_GL`` says.

    The first frame that somebody draws calls :func:`load_renderer`. Where dm_control was imported before, it is left as it is.
    """
    if "dm_control._render" in sys.modules:
        return
    wanted = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"  # for this import only: child processes and the renderer are to see the user's choice
    try:
        _import_dm_control().Renderer = _draw_on_demand
    finally:
        del os.environ["MUJOCO_GL"]
        if wanted is not None:
            os.environ["MUJOCO_GL"] = wanted


def _draw_on_demand(*args: Any, **kwargs: Any) -> Any:
    """Stands for dm_control's ``Renderer`` class until the first frame: makes an OpenGL context of the backend then chosen."""
    load_renderer()
    return sys.modules["dm_control._render"].Renderer(*args, **kwargs)


def load_renderer() -> str:
    """Choose the OpenGL backend, let dm_control draw with it, and make sure that it can without a display.

    ``MUJOCO_GL`` is respected where it is set. Where it is not, EGL is taken if it works, else OSMesa, and the variable
    is set, so that child processes agree. Costs about 20 ms before dm_control's own import; later calls are free.

    :return: dm_control's name of the backend: ``"egl"``, ``"osmesa"`` or ``"glfw"``
    :raises RenderingBackendError: if nothing can draw, or if dm_control was imported before with nothing that can
    """
    render = sys.modules.get("dm_control._render")
    postponed = render is not None and render.Renderer is _draw_on_demand
    already_imported = render is not None and not postponed
    if not already_imported:
        load_triton()
    if not already_imported and sys.platform == "linux" and "MUJOCO_GL" not in os.environ:
        os.environ["MUJOCO_GL"] = _choose_backend()
    try:
        backend = (importlib.reload(render) if postponed and render else _import_dm_control()).BACKEND
    except ModuleNotFoundError:
        raise  # a package is missing, not a graphics library
    except (AttributeError, ImportError, RuntimeError) as error:
        raise RenderingBackendError(
            f"dm_control cannot be imported with MUJOCO_GL={os.environ.get('MUJOCO_GL')!r}: {error}. {_INSTALL_HINT}"
        ) from error

    no_display = sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if backend not in ("egl", "osmesa", "glfw") or (backend == "glfw" and no_display):
        cause = (
            "dm_control was imported before any of this package's environments was made, and MUJOCO_GL was not set then: "
            "set it before that import."
            if already_imported
            else f"MUJOCO_GL={os.environ.get('MUJOCO_GL')!r} says so: unset it, or set it to egl or osmesa."
        )
        raise RenderingBackendError(f"dm_control draws with {backend!r}, which needs a display. {cause} {_INSTALL_HINT}")
    return backend


def _import_dm_control() -> Any:
    """Import dm_control with what ``MUJOCO_GL`` says.

    :return: its module ``_render``
    """
    # dm_control.composer and scipy change the process's warning filters on import: put the user's back.
    with warnings.catch_warnings():
        importlib.import_module("dm_control.composer")
        return importlib.import_module("dm_control._render")


def claim_renderer() -> None:
    """Note that this process draws; refuse where it was forked from one that had drawn before.

    Mesa's drawing threads do not survive a fork: the child's first frame would wait for them for ever.

    :raises RenderingBackendError: in such a child
    """
    global _rendering_pid
    if _rendering_pid is None:
        _rendering_pid = os.getpid()
    elif _rendering_pid != os.getpid():
        raise RenderingBackendError(
            f"process {os.getpid()} was forked from {_rendering_pid}, which had already rendered, and would hang. "
            "Use the start method 'forkserver' (SubprocVecEnv's default) or 'spawn'."
        )


def _choose_backend() -> str:
    """The first backend that works here.

    :return: ``"egl"`` or ``"osmesa"``
    :raises RenderingBackendError: if neither does
    """
    # PyOpenGL serves one platform a process; dm_control refuses to import a backend that contradicts this variable.
    platform = os.environ.get("PYOPENGL_PLATFORM")
    for name, works in (("egl", _egl_works), ("osmesa", _osmesa_works)):
        if platform in (None, "", name) and works():
            return name
    limit = f" PYOPENGL_PLATFORM={platform!r} restricts the choice." if platform else ""
    raise RenderingBackendError(
        f"neither EGL nor OSMesa works here, so MuJoCo cannot render.{limit} {_INSTALL_HINT} "
        "With a display, MUJOCO_GL=glfw works too."
    )


def _egl_works() -> bool:
    """Whether desktop OpenGL is there and some EGL device can be initialised.

    These are the calls dm_control makes when it is imported, but through ctypes, for PyOpenGL binds itself to one
    platform for good. Drivers without libgl1-mesa-dri load well and fail only in ``eglInitialize``: hence all of them.
    """
    egl = _load("libEGL.so.1", "libEGL.so")
    if egl is None or _load("libOpenGL.so.0", "libGL.so.1", "libGL.so") is None:
        return False
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    query_devices = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    get_display = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not query_devices or not get_display:
        return False

    pointer, integer = ctypes.c_void_p, ctypes.c_int
    devices, count = (pointer * _MAX_EGL_DEVICES)(), integer(0)
    query = ctypes.CFUNCTYPE(ctypes.c_uint, integer, ctypes.POINTER(pointer), ctypes.POINTER(integer))(query_devices)
    if not query(_MAX_EGL_DEVICES, devices, ctypes.byref(count)):
        return False
    candidates = list(devices[: count.value])
    wanted = os.environ.get("MUJOCO_EGL_DEVICE_ID")
    if wanted is not None:
        candidates = candidates[int(wanted) : int(wanted) + 1] if wanted.isdigit() else []

    display_of = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)(get_display)
    egl.eglInitialize.argtypes = [pointer, pointer, pointer]
    for device in candidates:
        display = display_of(_EGL_PLATFORM_DEVICE, device, None)
        if display and egl.eglInitialize(display, None, None):
            return True  # left initialised: dm_control initialises the same display next
    return False


def _osmesa_works() -> bool:
    """Whether there is an OSMesa library that can make the context dm_control asks for."""
    osmesa = _load("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")
    return osmesa is not None and hasattr(osmesa, "OSMesaCreateContextExt")


def _load(*names: str) -> ctypes.CDLL | None:
    """The first of some shared libraries that can be loaded.

    :param names: file names, best first
    """
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None
