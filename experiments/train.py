"""Train one method on one target task, all seeds at once: `python -m experiments.train --run-dir DIR`.

Interrupt it with Ctrl-C or SIGTERM at any time: it finishes the chunk at hand, saves, and says how to go on.  Started once per
host with --distributed, the processes share the lanes; interrupting one of them is enough.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import TypeVar

import envs
from apt_jax import checkpoint
from experiments import pictures, processes, run_dir, runtime
from experiments.command_line import parse
from experiments.errors import UsageError, exit_with
from experiments.interrupt import EXIT_CODE, Interrupt
from experiments.problem import make_problem
from experiments.programs import Programs
from experiments.progress import View, make_view
from experiments.run_dir import RunDir
from experiments.runner import Runner
from experiments.settings import Experiment, Session
from experiments.sinks import Metrics, Sink, check_installed, make_sinks
from experiments.summary import Times, is_complete, summarise

T = TypeVar("T")

SAVING = "stopping after this chunk, then saving; once more to stop at once and lose what is not saved"
NOTHING_TO_SAVE = "stopping once this is compiled; once more to stop at once, nothing is lost by that"
"""Answers to an interrupt."""

TASKS_PER_LANE = 8
TASKS_EVERY = 5
"""Chunks between samples of generated tasks."""


def main() -> int:
    """The command line."""
    experiment, session = parse()
    start_jax(session)
    return train(experiment, session)


def start_jax(session: Session) -> None:
    """What has to come before the first array: settings, and meeting the other processes if there are any."""
    runtime.setup(session.devices)
    if session.distributed:
        processes.join(session.coordinator_address, session.num_processes, session.process_id)


def train(experiment: Experiment, session: Session) -> int:
    """Trains until `experiment.env_steps` or an interrupt; returns the exit code."""
    problem = processes.together(lambda: make_problem(experiment))
    processes.from_first(lambda: check_installed(session.sinks))
    processes.check_same(repr((experiment, dataclasses.replace(session, process_id=None))))
    programs = kept_programs(experiment, session, problem.space)
    runner = Runner(problem.trainer, problem.target, experiment, session.layout, programs)
    run = RunDir(session.run_dir)
    if session.resume and processes.from_first(lambda: is_complete(run.path, experiment)):
        if processes.is_first():
            print(f"{run.path} has all its {experiment.env_steps:,} steps; pass a larger --env-steps to go on")
        return 0
    names = [lane.name for lane in experiment.lanes]
    with (
        Interrupt() as interrupt,
        make_view(names, experiment.env_steps) as view,
        ExitStack() as stack,
    ):
        stack.callback(run.release)
        start = processes.from_first(lambda: open_run(run, experiment, session))
        view.note(
            f"{experiment.config.method} on {experiment.space}, seeds {' '.join(map(str, experiment.seeds))}, into {run.path}"
        )
        view.note(runner.placement)
        sinks = [stack.enter_context(closing(sink)) for sink in open_sinks(experiment, session, start)]
        times = Times(before=run_dir.wall_seconds(run.path))
        Training(experiment, session, runner, run, view, sinks, interrupt, times).run(start)
        view.stop()
        policies = runner.policies()
        if processes.is_first() and run_dir.wall_seconds(run.path):
            pictures.draw(run.path, experiment, problem, policies)
            run.write_json("summary.json", summarise(run.path, experiment, times))  # last: it says that the run is complete
        if runner.env_steps < experiment.env_steps:
            view.note(f"stopped at {runner.env_steps:,} steps; to go on: {session.resume_command}")
            return EXIT_CODE
        view.note(f"finished {runner.env_steps:,} steps after {times.wall:.0f} s: {run.path}")
        return EXIT_CODE if processes.any_of(interrupt.requested) else 0  # asked to stop too late for this run, not for a next


def kept_programs(experiment: Experiment, session: Session, space: envs.BenchmarkSpace) -> Programs:
    """Programs are kept for one process whose task space and method come with this project: then all sources are known."""
    if session.distributed or experiment.plugins or not type(space).__module__.startswith(f"{envs.__name__}."):
        return Programs()
    return Programs.of(experiment.space, experiment.config, len(experiment.lanes), session.layout)


def open_sinks(experiment: Experiment, session: Session, start: int) -> list[Sink]:
    """The sinks asked for, which go on where the run does; none in any process but the first."""
    names = session.sinks if processes.is_first() else ()
    return make_sinks(names, session.run_dir, start=start, lanes=experiment.lanes, config=dataclasses.asdict(experiment))


def open_run(run: RunDir, experiment: Experiment, session: Session) -> int:
    """Makes a new run directory, or the one to resume as it was at its checkpoint; returns that one's steps, 0 without any.

    Raises:
      UsageError: a new one holds something already; or one to resume is another process's, or has results but its checkpoint is
        gone, or the other way round.
    """
    config = dataclasses.asdict(experiment)
    if not session.resume:
        run.create(config, experiment.target_file)
        return 0
    run.hold()
    start = checkpoint.latest_step(run.checkpoints) or 0
    if not start and run.has_results:
        raise UsageError(f"{run.path} has results, but no checkpoint to go on from (checkpoints/); take another --run-dir")
    if start > experiment.config.warmup_steps and not run.has_results:
        raise UsageError(
            f"{run.path} has a checkpoint of {start:,} steps, but no results (metrics.csv); take another --run-dir"
        )
    run.rewind(start)
    run.write_json("config.json", {**config, "target_file": run_dir.read_config(run.path)["target_file"]})
    return start


@dataclass
class Training:
    """The host loop: what happens before, between and after chunks."""

    experiment: Experiment
    session: Session
    runner: Runner
    run_dir: RunDir
    view: View
    sinks: Sequence[Sink]
    interrupt: Interrupt
    times: Times

    def run(self, start: int) -> None:
        """From the checkpoint of `start` steps, if any, to the end or an interrupt; the last chunk is always saved."""
        self._begin(start)
        going = self._unfinished()
        while going:
            began = time.monotonic()
            metrics = self._patiently(self.runner.advance)
            self.times.training += time.monotonic() - began
            self.times.trained_steps += self.experiment.config.eval_every
            self._record(metrics)
            going = self._unfinished()  # asked once, so that an interrupt cannot slip in between saving and leaving
            if not going or self._due(TASKS_EVERY * self.experiment.config.eval_every):
                self._sample_tasks()
            if not going or self._due(self.session.checkpoint_every):
                self.runner.save(self.run_dir.checkpoints)

    def _begin(self, start: int) -> None:
        self.view.note("compiling, or loading what an earlier start has compiled")
        self.times.compile = self._patiently(self.runner.init, NOTHING_TO_SAVE)
        if start:
            self.runner.restore(self.run_dir.checkpoints)
            self.view.note(f"restored {self.runner.env_steps:,} steps")
        if self._unfinished():
            self.times.compile += self._patiently(self.runner.compile, NOTHING_TO_SAVE)
            self.view.note(f"{'compiled' if self.runner.programs.compiled else 'loaded'} in {self.times.compile:.1f} s")
        if self.runner.env_steps == 0 and self._unfinished():
            self._patiently(self.runner.warmup)
            self._sample_tasks()
            self.runner.save(self.run_dir.checkpoints)
        self.view.start(self.runner.env_steps)

    def _unfinished(self) -> bool:
        return self.runner.env_steps < self.experiment.env_steps and not processes.any_of(self.interrupt.requested)

    def _due(self, every: int) -> bool:
        """Whether the chunk at hand reached a multiple of `every`."""
        return self.runner.env_steps % every < self.experiment.config.eval_every

    def _record(self, metrics: Metrics) -> None:
        index = [lane.index for lane in self.experiment.lanes]
        processes.from_first(lambda: self.run_dir.append_metrics(self.runner.env_steps, self.times.wall, index, metrics))
        self.view.write(self.runner.env_steps, metrics)
        for sink in self.sinks:
            sink.write(self.runner.env_steps, metrics)

    def _sample_tasks(self) -> None:
        if self.runner.generates:
            w = self.runner.propose(TASKS_PER_LANE)
            processes.from_first(lambda: self.run_dir.write_tasks(self.runner.env_steps, w))

    def _patiently(self, work: Callable[[], T], answer: str = SAVING) -> T:
        """Does long work and stays able to answer an interrupt."""

        def acknowledge() -> None:
            self.view.stop()
            self.view.note(answer)

        return self.interrupt.run(work, on_request=acknowledge)


if __name__ == "__main__":
    exit_with(main)
