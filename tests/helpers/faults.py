"""``make faults``: inject every fault, print a table of injections and outcomes (docs/reliability.md shows one).

Arguments go to pytest. Ends with status 1 if an outcome is not what it should be.
"""

from __future__ import annotations

import sys
import time

import pytest
from places import file_of

#: injection → tests (file, then what the names of the tests begin with), outcome that they check
INJECTIONS: dict[str, tuple[list[tuple[str, str]], str]] = {
    "SIGKILL of a run at random moments, resumed each time": (
        [("run_folder", "kill_at_random")],
        "the same bits as a run that was not killed",
    ),
    "SIGKILL of rl_zoo3's command in both phases, gone on with by `-i`": (
        [("zoo_resume", "kill_9")],
        "the same bits, evaluations and episodes as a run that was not killed",
    ),
    'a script that crashes and is started again (`resume="auto"`), VecNormalize, a full replay on disk': (
        [("resume", "the_same_script"), ("resume", "a_run_with_vecnormalize"), ("run_folder", "400_steps")],
        "the same bits",
    ),
    "SIGKILL at every write step of a checkpoint": (
        [("fault_injection", "kill_at_every")],
        "the old checkpoint or the new one, whole, with its replay",
    ),
    "SIGKILL while saving over and over": ([("snapshot", "kill_in_the_middle")], "a whole file, old or new"),
    "SIGKILL while writing a replay on disk": ([("stores", "kill_while_writing")], "whole episodes, none missing"),
    "SIGTERM, SIGINT, a second signal": (
        [("run_folder", "sigterm"), ("run_folder", "the_second"), ("run_folder", "sigint")],
        "checkpoint and exit; at once",
    ),
    "400 snapshots and 60 replay files with flipped bits, cuts, doubled bytes": (
        [("snapshot", "damaged"), ("snapshot", "stumps")],
        "refused, or the same model",
    ),
    "replay on disk cut, overwritten, without its cursor, with rows missing": (
        [("stores", "a_damaged"), ("stores", "missing_rows")],
        "refused, or one error that names the rows",
    ),
    "pickles in every member, foreign members, paths that leave the folder, compressed members, wrong sizes, 20,000 members": (
        [("snapshot", "a_pickle"), ("snapshot", "members_that"), ("snapshot", "the_zip"), ("snapshot", "bare")],
        "refused; under an audit hook no pickle, exec, import, system call or subprocess",
    ),
    "JSON with double keys, NaN, depth, long numbers; `predict` among the fields; values of wrong type and range": (
        [("snapshot", "json_out"), ("snapshot", "fields"), ("snapshot", "values"), ("snapshot", "loading_runs")],
        "refused, likewise",
    ),
    "tables of tensors with other names, types, shapes; networks of terabytes": (
        [("snapshot", "tensors_that"), ("snapshot", "large")],
        "refused before memory is taken",
    ),
    "full disk, full device, file size limit": (
        [("run_folder", "a_full_disk"), ("snapshot", "a_full_device"), ("stores", "a_full_disk")],
        "last checkpoint and rows intact, one error with the path",
    ),
    "a replay file that may not grow": ([("stores", "the_file_is_bounded")], "the oldest episodes go"),
    "two runs in one folder, two buffers in one file": (
        [("run_folder", "two_writers"), ("stores", "two_buffers")],
        "the second is refused",
    ),
    "worker dies, raises, gives NaN": (
        [("supervisor", "a_fault_ends"), ("supervisor", "a_worker_that"), ("supervisor", "a_run_over")],
        "replaced, episode truncated, counted; the run goes on",
    ),
    "worker hangs": ([("supervisor", "a_hanging")], "replaced after step_timeout"),
    "worker fails again and again, or cannot start": (
        [("supervisor", "repeated"), ("supervisor", "an_environment")],
        "one error names environment and step",
    ),
    "an environment is given up on in the middle of a run, or of an evaluation": (
        [("resume", "a_run_that_an"), ("resume", "a_run_without"), ("resume", "an_environment_of")],
        "a checkpoint or a snapshot first; one error names it",
    ),
    "close() with dead, hanging, stopped, busy workers": (
        [("supervisor", "close_returns"), ("supervisor", "a_process_ends")],
        "returns within 5 s, no process is left",
    ),
    "PhysicsError, NaN, Inf in one process": (
        [("env_faults", name) for name in ("a_bad_step", "a_reset", "repeated", "a_run", "the_walker")],
        "episode truncated, no such row stored; repeated: one error",
    ),
    "NaN and Inf in actions": (
        [("env_faults", "a_bad_action"), ("env_faults", "an_action"), ("supervisor", "an_action")],
        "never reaches the simulation",
    ),
    "NaN and Inf in losses and gradients": (
        [("numerical_faults", "")],
        "update skipped and counted; 20 in a row: stop, last good state saved",
    ),
    "2000 steps, 3 rendering environments, 7 deaths of a worker": (
        [("fault_injection", "soak")],
        "memory, open files and threads stay",
    ),
}


class Outcomes:
    """Collects what became of each test; pytest calls it."""

    def __init__(self) -> None:
        self.results: dict[str, tuple[str, float]] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep the worst of a test's three parts."""
        before = self.results.get(report.nodeid, ("passed", 0.0))
        outcome = report.outcome if report.outcome != "passed" else before[0]
        self.results[report.nodeid] = (outcome, before[1] + report.duration)

    def of(self, tests: list[tuple[str, str]]) -> tuple[list[str], float]:
        """Outcomes and seconds of the tests of an injection."""
        marks = [f"test_{file}.py::test_{name}" for file, name in tests]
        mine = [result for node, result in self.results.items() if any(mark in node for mark in marks)]
        return [outcome for outcome, _ in mine], sum(seconds for _, seconds in mine)


def main(arguments: list[str]) -> int:
    """Run the injections.

    :param arguments: for pytest
    :return: exit status
    """
    files = sorted({file for tests, _ in INJECTIONS.values() for file, _ in tests})
    outcomes, start = Outcomes(), time.monotonic()
    pytest.main(["-q", "-m", "faults or not slow", *(str(file_of(file)) for file in files), *arguments], [outcomes])
    print("\n| injection | outcome | tests | seconds |\n|---|---|---|---|")
    bad = False
    for injection, (tests, expected) in INJECTIONS.items():
        results, seconds = outcomes.of(tests)
        failed, skipped = results.count("failed"), results.count("skipped")
        # None at all: renamed, or deselected.
        bad |= failed > 0 or not results
        text = expected if results and not failed else f"**{failed} of {len(results)} FAILED**"
        count = f"{len(results)}, {skipped} skipped" if skipped else f"{len(results)}"
        print(f"| {injection} | {text} | {count} | {seconds:.0f} |")
    print(f"\n{time.monotonic() - start:.0f} s")
    return int(bad or any(outcome == "failed" for outcome, _ in outcomes.results.values()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
