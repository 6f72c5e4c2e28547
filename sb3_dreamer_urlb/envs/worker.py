"""One environment in a process of its own: the process's main function, and the parent's handle of it.

Every answer is waited for with a time limit, and beside the process's sentinel: a worker that died or hangs is a
:class:`WorkerFault`, never a block for ever (SB3 #1814, #1890).
"""

from __future__ import annotations

import multiprocessing as mp
import os
import pickle
import signal
import socket
import struct
import time
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from typing import Any

import gymnasium

from sb3_dreamer_urlb.envs.faults import FaultGuard, describe
from sb3_dreamer_urlb.envs.info_keys import TERMINAL, TRUNCATED
from sb3_dreamer_urlb.envs.touches import with_own_observation

OK, RAISED = "ok", "raised"


class WorkerFault(Exception):
    """A worker died or hangs."""


# -- in the worker ---------------------------------------------------------------------------------------------------------


def serve(remote: Connection, env_fn: Any, name: str, max_faults: int) -> None:
    """What the process does: make the environment, then answer until told to stop or the parent is gone.

    :param remote: to the parent
    :param env_fn: SB3's CloudpickleWrapper of a function that makes the environment
    :param name: of the environment, for messages
    :param max_faults: in a row, see :class:`FaultGuard`
    """
    # Ctrl-C reaches the whole group: the parent finishes its step, and needs its environments for that.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    env: gymnasium.Env | None = None
    try:
        while True:
            number, command, data = remote.recv()
            if command == "close":
                break
            try:
                if env is None:
                    # The first command, so that an error on the way is answered like any other.
                    env = FaultGuard(env_fn.var(), max_faults, name)
                answer = ForkingPickler.dumps((number, OK, _COMMANDS[command](env, data)))
            except Exception as error:
                # Of the environment, or of an answer that cannot be sent.
                answer = ForkingPickler.dumps((number, RAISED, _portable(error)))
            remote.send_bytes(answer)
    except (EOFError, OSError):
        pass  # the parent is gone
    if env is not None:
        env.close()


def _portable(error: Exception) -> Exception:
    """An error that survives the way to the parent."""
    try:
        pickle.loads(pickle.dumps(error))
        return error
    except Exception:
        return RuntimeError(describe(error))


def _step(env: gymnasium.Env, action: Any) -> tuple[Any, ...]:
    observation, reward, terminated, truncated, info = with_own_observation(env.step(action))
    reset_info: dict[str, Any] = {}
    info = {**info, TRUNCATED: truncated and not terminated}
    if terminated or truncated:
        info[TERMINAL] = observation
        observation, reset_info = env.reset()
    return observation, reward, terminated or truncated, info, reset_info


def _reset(env: gymnasium.Env, data: tuple[int | None, dict[str, Any]]) -> tuple[Any, dict[str, Any]]:
    seed, options = data
    return env.reset(seed=seed, options=options or None)


def _is_wrapped(env: gymnasium.Env, wrapper: type[gymnasium.Wrapper]) -> bool:
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, wrapper):
            return True
        env = env.env
    return False


_COMMANDS: dict[str, Callable[[gymnasium.Env, Any], Any]] = {
    "spaces": lambda env, _: (env.observation_space, env.action_space),
    "step": _step,
    "reset": _reset,
    "render": lambda env, _: env.render(),
    "method": lambda env, data: env.get_wrapper_attr(data[0])(*data[1], **data[2]),
    "get": lambda env, name: env.get_wrapper_attr(name),
    # Where the environment itself sees it, as SB3's workers set it on the outermost wrapper, which is the user's own.
    "set": lambda env, data: setattr(env.env, *data),  # type: ignore[attr-defined]
    "is_wrapped": _is_wrapped,
}


# -- in the parent ---------------------------------------------------------------------------------------------------------


class Worker:
    """A worker as its parent sees it.

    :param context: of multiprocessing
    :param env_fn: SB3's CloudpickleWrapper of a function that makes the environment
    :param name: of the environment, for messages
    :param max_faults: in a row, see :class:`FaultGuard`
    :param step_timeout: seconds that an answer may take
    :param start_timeout: seconds that the first answer may take: the process starts, and imports
    """

    def __init__(
        self, context: Any, env_fn: Any, name: str, max_faults: int, step_timeout: float, start_timeout: float
    ) -> None:
        self.name = name
        self.step_timeout, self.start_timeout = step_timeout, start_timeout
        self._asked = 0
        self._answered = False
        self.remote, theirs = context.Pipe()
        _limit_blocking(self.remote, step_timeout)
        self.process = context.Process(target=serve, args=(theirs, env_fn, name, max_faults), daemon=True)
        self.process.start()
        theirs.close()

    def send(self, command: str, data: Any = None) -> None:
        """Ask; :meth:`receive` gets the answer.

        :raises WorkerFault: if the worker is gone
        """
        self._asked += 1
        try:
            self.remote.send((self._asked, command, data))
        except OSError as error:
            raise self._fault(error) from None

    def receive(self) -> Any:
        """The answer to the last question.

        :raises WorkerFault: if the worker died or takes too long
        :raises Exception: what the environment raised
        """
        timeout = self.step_timeout if self._answered else self.start_timeout
        deadline = time.monotonic() + timeout
        number = 0
        try:
            # Answers to older questions: an error elsewhere kept the parent from taking them.
            while number != self._asked:
                ready = wait([self.remote, self.process.sentinel], max(deadline - time.monotonic(), 0))
                # An answer sent before death still counts.
                if self.remote not in ready and not self.remote.poll():
                    raise self._fault(TimeoutError(f"no answer within {timeout:g} s"))
                number, kind, answer = self.remote.recv()
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            raise self._fault(error) from None
        self._answered = True
        if kind == RAISED:
            raise answer
        return answer

    def _fault(self, error: Exception) -> WorkerFault:
        """What happened, in words."""
        if isinstance(error, (TimeoutError, BlockingIOError)) and self.process.is_alive():
            return WorkerFault(f"its process hangs ({describe(error)})")
        self.process.join(1)
        code = self.process.exitcode
        how = f"by signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"with exit code {code}"
        return WorkerFault(f"its process ended {how}")

    def kill(self) -> None:
        """End it now."""
        if self.process.is_alive():
            self.process.kill()
            self.process.join(1)
        self.remote.close()


def end_all(workers: list[Worker], grace: float) -> None:
    """End workers, by kindness and then by force; returns after ``grace`` and two seconds at the latest.

    :param workers: to end
    :param grace: seconds they have to close their environments
    """
    for worker in workers:
        try:
            worker.remote.send((0, "close", None))
        except (OSError, ValueError):
            pass  # gone already
    _join(workers, grace)
    for worker in workers:
        worker.kill()
    _join(workers, 2.0)


def _join(workers: list[Worker], seconds: float) -> None:
    deadline = time.monotonic() + seconds
    for worker in workers:
        worker.process.join(max(deadline - time.monotonic(), 0))


def _limit_blocking(remote: Connection, seconds: float) -> None:
    """Let a send or a receive that has begun fail after a while: a worker may stop in the middle of an answer."""
    with socket.socket(fileno=os.dup(remote.fileno())) as link:
        for option in (socket.SO_RCVTIMEO, socket.SO_SNDTIMEO):
            link.setsockopt(socket.SOL_SOCKET, option, struct.pack("ll", int(seconds), int(seconds % 1 * 1e6)))


def start_context(start_method: str | None) -> Any:
    """The multiprocessing context for environments.

    :param start_method: ``"forkserver"`` or ``"spawn"``; None takes the first that exists
    :raises ValueError: for ``"fork"``: a child of a process that has rendered hangs (EGL and OSMesa)
    """
    known = [name for name in ("forkserver", "spawn") if name in mp.get_all_start_methods()]
    if start_method is None:
        start_method = known[0]
    if start_method not in known:
        raise ValueError(
            f"start_method={start_method!r}: expected one of {known}. A forked child of a process that has rendered hangs."
        )
    context = mp.get_context(start_method)
    if start_method == "forkserver":
        # A worker that replaces another need not import everything again.
        context.set_forkserver_preload(["__main__", "stable_baselines3", __name__])
    return context
