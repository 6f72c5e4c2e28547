"""Finding an OpenGL backend: before dm_control is imported, whatever is installed, with one clear error."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from without_display import run

from sb3_dreamer_urlb.envs import RenderingBackendError, rendering

REPORT_ERROR = """
from sb3_dreamer_urlb.envs import RenderingBackendError, make_urlb_env
try:
    make_urlb_env("walker", "run").reset()
except RenderingBackendError as error:
    print(error)
"""


def test_importing_the_package_imports_nothing_heavy():
    code = """
import sys, sb3_dreamer_urlb.envs as envs
envs.register_envs()
print(*[name for name in ("dm_control", "mujoco", "shimmy", "OpenGL", "glfw") if name in sys.modules], "none")
"""
    assert run(code) == "none"


def test_every_module_that_imports_dm_control_leaves_the_choice_to_the_first_frame():
    """Imported without OpenGL, whose libraries load when the backend is chosen; the user's variables stay as they are."""
    code = """
import importlib, os, sys, sb3_dreamer_urlb.envs as envs
modules = [name[:-3] for name in os.listdir(os.path.dirname(envs.__file__)) if name.endswith(".py")]
modules = [name for name in modules if name not in ("__init__", "supervisor", "worker")]  # SB3's affair
for module in modules:
    if os.fork() == 0:
        importlib.import_module("sb3_dreamer_urlb.envs." + module)
        loaded = [name for name in sys.modules if name.split(".")[0] == "OpenGL"]  # Shimmy imports GLFW, which loads none
        assert not loaded and "MUJOCO_GL" not in os.environ, (module, loaded)
        backend = envs.load_renderer()
        import dm_control._render
        os._exit(0 if dm_control._render.BACKEND == os.environ["MUJOCO_GL"] == backend else 1)
    print(os.wait()[1])
assert len(modules) > 8, modules
"""
    assert set(run(code).split()) == {"0"}


def test_unset_takes_a_backend_that_draws():
    code = """
import os, sb3_dreamer_urlb.envs as envs
env = envs.make_urlb_env("walker", "run")
print(os.environ["MUJOCO_GL"], env.reset(seed=0)[0].std() > 10)
env.close()
"""
    assert run(code) in ("egl True", "osmesa True")


def test_the_probe_is_quick():
    code = """
import time
from sb3_dreamer_urlb.envs import rendering
start = time.process_time()
rendering._choose_backend()
print(time.process_time() - start)
"""
    assert float(run(code)) < 0.3


def test_the_users_choice_and_warning_filters_are_respected(monkeypatch):
    code = """
import warnings
from sb3_dreamer_urlb.envs import rendering
filters = list(warnings.filters)
def asked(): raise AssertionError
rendering._choose_backend = asked
print(rendering.load_renderer(), filters == list(warnings.filters))
"""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    works = rendering._choose_backend()
    assert run(code, MUJOCO_GL=works) == f"{works} True"


@pytest.mark.parametrize(
    ("libraries", "expected"),
    [
        ({"libEGL.so.1", "libOpenGL.so.0", "libOSMesa.so.8"}, "egl"),
        ({"libEGL.so.1", "libGL.so.1"}, "egl"),
        ({"libEGL.so.1", "libOSMesa.so.8"}, "osmesa"),  # EGL without desktop OpenGL
        ({"libOSMesa.so.6"}, "osmesa"),
        ({"libEGL.so.1"}, None),
        (set(), None),
    ],
)
def test_the_choice_by_what_is_installed(libraries, expected, monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.delenv("MUJOCO_EGL_DEVICE_ID", raising=False)
    load = rendering._load

    def some(*names):
        if not libraries.intersection(names):
            return None
        return SimpleNamespace(OSMesaCreateContextExt=None) if "libOSMesa.so.8" in names else load(*names)

    if expected == "egl" and not rendering._egl_works():
        pytest.skip("no EGL here")
    monkeypatch.setattr(rendering, "_load", some)
    if expected:
        assert rendering._choose_backend() == expected
    else:
        with pytest.raises(RenderingBackendError, match=r"apt-get install libegl1 .*apt-get install libosmesa6"):
            rendering._choose_backend()


def test_egl_libraries_without_a_driver_do_not_count(monkeypatch):
    """Without libgl1-mesa-dri, or with a device id that there is not, the libraries load and no display starts."""
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", "9")
    assert not rendering._egl_works()


def test_pyopengls_platform_restricts_the_choice(monkeypatch):
    monkeypatch.setattr(rendering, "_egl_works", lambda: True)
    monkeypatch.setattr(rendering, "_osmesa_works", lambda: True)
    for platform, expected in (("egl", "egl"), ("osmesa", "osmesa"), ("", "egl")):
        monkeypatch.setenv("PYOPENGL_PLATFORM", platform)
        assert rendering._choose_backend() == expected
    monkeypatch.setenv("PYOPENGL_PLATFORM", "glx")
    with pytest.raises(RenderingBackendError, match="PYOPENGL_PLATFORM='glx'"):
        rendering._choose_backend()


def test_nothing_installed_is_one_clear_error():
    code = "from sb3_dreamer_urlb.envs import rendering; rendering._load = lambda *names: None" + REPORT_ERROR
    assert "neither EGL nor OSMesa works here" in run(code)


def test_dm_control_imported_first_with_no_display():
    message = run("import dm_control.suite" + REPORT_ERROR)
    assert "dm_control was imported before" in message and "apt-get install" in message


@pytest.mark.parametrize(("choice", "part"), [("glfw", "needs a display"), ("vulkan", "must be one of")])
def test_a_choice_that_cannot_draw_is_named(choice, part):
    message = run(REPORT_ERROR, MUJOCO_GL=choice)
    assert f"MUJOCO_GL={choice!r}" in message and part in message


@pytest.mark.skipif(rendering._osmesa_works(), reason="OSMesa is installed")
def test_a_chosen_backend_that_is_not_installed():
    message = run(REPORT_ERROR, MUJOCO_GL="osmesa")
    assert "MUJOCO_GL='osmesa'" in message and "libosmesa6" in message


def test_a_fork_after_rendering_is_refused_and_does_not_hang():
    code = """
import os
from sb3_dreamer_urlb.envs import RenderingBackendError, make_urlb_env
env = make_urlb_env("walker", "run")
if os.fork() == 0:  # nothing was drawn yet: fine
    env.reset()
    os._exit(0)
assert os.wait()[1] == 0
env.reset()
if os.fork() == 0:
    try:
        make_urlb_env("walker", "run").reset()
    except RenderingBackendError as error:
        os._exit(0 if "forkserver" in str(error) else 1)
    os._exit(2)
print(os.wait()[1])
"""
    assert run(code) == "0"
