"""Several machines and several workers: one window of each machine at a time, and nobody waits for another one."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.packed_state import PackedState
from otolith.health.schema import Report
from otolith.kernel_cache import CompileStep
from otolith.runtime.hall.machine import Machine, Task, WorkerResult
from otolith.runtime.hall.pool import COMPILE_TIMEOUT, TURN, WINDOW_TIMEOUT, Pool
from otolith.runtime.worker import Ready, perform
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.acquisition.series import uncut
from tests.estimation.test_window_fit import Cut, state_for
from tests.runtime.pools import LENGTH, machine_of


class Process:
    """A worker process that answers when the test says so."""

    def __init__(self) -> None:
        self.alive, self.starts, self.processor_time = False, 0, 0.0
        self.is_quick = True  # Whether it is ready as soon as it has started
        self.taken: list[tuple[PackedState, Task]] = []
        self.sent: list[object] = [Ready()]
        self.started: list[PackedState] = []

    def start(self, state: PackedState) -> None:
        self.alive, self.starts, self.sent = True, self.starts + 1, [Ready()] * self.is_quick
        self.started.append(state)

    def may_restart(self, _: float) -> bool:
        return not self.alive

    def offer(self, message: tuple[PackedState, Task]) -> bool:
        self.taken.append(message)
        return True

    def replies(self) -> list[object]:
        sent, self.sent = self.sent, []
        return sent

    def reset_backoff(self) -> None:
        """Nothing has ended."""

    def kill(self) -> None:
        self.alive = False

    def finish(self, report: Report, seconds: float = 0.01) -> None:
        """Answer the window that was taken last."""
        state, task = self.taken[-1]
        window = Window.whole(task.index, 0.0, 0.01, (), report.traces.measured[:, :0])
        self.sent.append(WorkerResult(task.index, window, state, report, seconds, ""))


Halls = Callable[[int, int], tuple[Pool, list[Machine], list[Process]]]


@pytest.fixture
def hall() -> Halls:
    """Function that returns a pool with so many machines and workers, which are ready."""

    def made(machines: int, workers: int) -> tuple[Pool, list[Machine], list[Process]]:
        return hall_of([machine_of(state_for("R_a")) for _ in range(machines)], workers)

    return made


def hall_of(served: list[Machine], workers: int) -> tuple[Pool, list[Machine], list[Process]]:
    """A pool for these machines, whose workers are ready."""
    pool, processes = Pool(served, workers), [Process() for _ in range(workers)]
    for worker, process in zip(pool.workers, processes, strict=True):
        worker.process = process  # type: ignore[assignment]  # has the methods that are used
    pool.start(0.0)
    pool.poll(0.0)
    return pool, served, processes


@pytest.fixture
def tasks(scenario: MotorScenario, windows: Cut) -> list[Task]:
    return [Task(uncut(window)) for window, _ in windows(scenario, 3)]


@pytest.fixture
def report(scenario: MotorScenario, windows: Cut) -> Report:
    ((window, _),) = windows(scenario, 1)
    done = perform(state_for("R_a"), window).report
    assert done is not None
    return done


def test_a_machine_has_one_window_in_a_worker_and_any_worker_takes_any_machine(
    hall: Halls, tasks: list[Task], report: Report
) -> None:
    pool, (first, second), (one, other) = hall(2, 2)
    pool.submit(first, tasks[0], 0.0)
    pool.submit(first, tasks[1], 0.0)
    assert [len(process.taken) for process in (one, other)] == [1, 0]
    pool.submit(second, tasks[0], 0.0)
    assert [len(process.taken) for process in (one, other)] == [1, 1]
    other.finish(report)
    assert [machine for machine, _ in pool.poll(1.0)] == [second]
    assert len(other.taken) == 1  # the second window of the first machine waits for its first one
    one.finish(report)
    assert [machine for machine, _ in pool.poll(2.0)] == [first]
    assert [task.index for _, task in one.taken] == [0, 1]


def test_machines_take_turns_where_workers_are_few(hall: Halls, tasks: list[Task], report: Report) -> None:
    pool, machines, (worker,) = hall(3, 1)
    for task in tasks[:2]:
        for machine in machines:
            pool.submit(machine, task, 0.0)
    order = []
    for step in range(6):
        worker.finish(report)
        order += [machines.index(machine) for machine, _ in pool.poll(float(step))]
    assert order == [0, 1, 2, 0, 1, 2]


def test_a_window_that_kills_its_workers_costs_that_window_of_that_machine(
    hall: Halls, tasks: list[Task], report: Report
) -> None:
    pool, (hostile, well), (one, other) = hall(2, 2)
    pool.submit(hostile, tasks[0], 0.0)
    pool.submit(well, tasks[0], 0.0)
    for _ in range(2):
        next(process for process in (one, other) if process.taken[-1][0] is hostile.packed).alive = False
        pool.poll(1.0)
        pool.poll(1.0)  # the new worker is ready
    assert (hostile.missed, well.missed) == (1, 0)
    for process in (one, other):
        if pool.workers[(one, other).index(process)].machine is well:
            process.finish(report)
    assert [machine for machine, _ in pool.poll(2.0)] == [well]


def test_each_window_has_a_deadline_of_its_own(hall: Halls, tasks: list[Task]) -> None:
    pool, (first, second), (one, other) = hall(2, 2)
    pool.submit(first, tasks[0], 0.0)
    pool.poll(10.0)
    pool.submit(second, tasks[0], 15.0)
    late = WINDOW_TIMEOUT + 2 * LENGTH + 0.1
    pool.poll(late)
    assert (one.alive, other.alive) == (False, True)


def test_machines_that_compute_for_long_leave_a_worker_to_the_others(
    hall: Halls, tasks: list[Task], report: Report
) -> None:
    """As twins that diverge: each of their windows takes longer than it lasts."""
    pool, (slow, slower, well), (one, other) = hall(3, 2)
    for machine, process in ((slow, one), (slower, other)):
        pool.submit(machine, tasks[0], 0.0)
        process.finish(report, 2.0 * LENGTH)
    assert len(pool.poll(1.0)) == 2
    pool.submit(slow, tasks[1], 2.0)
    pool.submit(slower, tasks[1], 2.0)
    pool.submit(well, tasks[0], 2.0)
    busy = [worker.machine for worker in pool.workers]
    assert busy == [slow, well]
    one.finish(replace(report), 2.0 * LENGTH)
    pool.poll(3.0)
    assert [worker.machine for worker in pool.workers] == [slower, well]


def test_a_pool_with_one_worker_computes_also_what_takes_long(hall: Halls, tasks: list[Task], report: Report) -> None:
    pool, (slow,), (worker,) = hall(1, 1)
    for task in tasks:
        pool.submit(slow, task, 0.0)
        worker.finish(report, 2.0 * LENGTH)
        assert len(pool.poll(1.0)) == 1


def test_the_pool_has_stalled_if_all_of_its_workers_have(hall: Halls, tasks: list[Task], report: Report) -> None:
    pool, machines, (_, other) = hall(2, 2)
    for worker in pool.workers:
        worker.stall.begin(0.0, 0.0)
    for machine in machines:
        pool.submit(machine, tasks[0], 0.0)
    assert not pool.is_stalled(30.0)
    assert pool.is_stalled(1e3)
    other.finish(report)
    pool.poll(1e3)
    assert not pool.is_stalled(1e3)


def test_a_new_worker_warms_up_for_another_machine_if_the_one_before_died_of_it(hall: Halls) -> None:
    """A twin that kills the worker while it starts concerns no other machine."""
    pool, machines, (worker,) = hall(2, 1)
    for _ in range(2):
        worker.alive = False
        pool.poll(1.0)
    assert {id(state) for state in worker.started} == {id(machine.packed) for machine in machines}


def test_no_window_waits_for_a_worker_that_starts_while_another_one_is_ready(
    hall: Halls, tasks: list[Task], report: Report
) -> None:
    pool, (first, second), (one, other) = hall(2, 2)
    other.alive = False
    pool.poll(1.0)
    pool.poll(1.0)
    other.sent = []
    pool.workers[1].is_ready = False
    pool.submit(first, tasks[0], 2.0)
    pool.submit(second, tasks[0], 2.0)
    assert (len(one.taken), len(other.taken)) == (1, 0)
    one.finish(report)
    assert [machine for machine, _ in pool.poll(3.0)] == [first]
    assert (len(one.taken), len(other.taken)) == (2, 0)
    one.finish(report)
    pool.poll(4.0)
    pool.workers[1].begin(4.0)
    pool.workers[1].is_compiling = True
    pool.poll(3.0 + COMPILE_TIMEOUT + WINDOW_TIMEOUT)
    assert other.alive
    pool.poll(5.0 + COMPILE_TIMEOUT + WINDOW_TIMEOUT)
    assert not other.alive  # it hangs while it starts, although it has no window


def test_the_window_of_a_worker_that_died_does_not_wait_until_the_next_one_has_started(
    hall: Halls, tasks: list[Task]
) -> None:
    pool, (machine, _), (one, other) = hall(2, 2)
    pool.submit(machine, tasks[0], 0.0)
    one.alive, one.is_quick = False, False
    pool.poll(1.0)
    assert [task.index for _, task in other.taken] == [0]


HOSTILE, WELL, NEW = "R_a", "D", "J"  # The parameter that a machine estimates: each needs kernels of its own


def hangs(process: Process) -> None:
    """From now on the process compiles a kernel that has no end."""
    process.sent = [CompileStep("kernel", is_end=False, compiled=False)]


def test_a_twin_that_hangs_while_it_is_compiled_leaves_a_worker_to_the_others(
    tasks: list[Task], report: Report
) -> None:
    """Both workers hung for ten minutes: one at its start, the other in the first window of this machine."""
    machines = [machine_of(state_for(name)) for name in (HOSTILE, HOSTILE, WELL, WELL)]
    pool, processes = Pool(machines, 2), [Process(), Process()]
    for worker, process in zip(pool.workers, processes, strict=True):
        worker.process = process  # type: ignore[assignment]  # has the methods that are used
    pool.start(0.0)
    stuck, free = processes if processes[0].started[0] is machines[0].packed else processes[::-1]
    assert free.started[0] is machines[2].packed  # not that of the other hostile one
    hangs(stuck)
    pool.poll(0.1)
    for second in range(1, 50):
        for machine in machines:
            pool.submit(machine, tasks[second % len(tasks)], float(second))
        for _ in range(2):
            taken = pool.workers[processes.index(free)].machine
            assert taken in machines[2:]
            free.finish(report)
            pool.poll(float(second))
    assert machines[2].finished == machines[3].finished == 49
    assert machines[2].missed == machines[3].missed == 0


def test_kernels_that_hang_are_killed_early_while_others_wait_to_be_compiled(tasks: list[Task], report: Report) -> None:
    machines = [machine_of(state_for(name)) for name in (HOSTILE, WELL, NEW)]
    pool, processes = Pool(machines, 2), [Process(), Process()]
    for worker, process in zip(pool.workers, processes, strict=True):
        worker.process = process  # type: ignore[assignment]  # has the methods that are used
    pool.start(0.0)
    stuck, free = processes if processes[0].started[0] is machines[0].packed else processes[::-1]
    hangs(stuck)
    pool.poll(0.0)
    pool.poll(TURN + 1.0)
    assert stuck.alive  # nobody waits for it
    pool.submit(machines[2], tasks[0], TURN + 1.0)
    assert not free.taken  # kernels that are new leave a worker to the others
    pool.poll(TURN + 2.0)
    assert not stuck.alive
    pool.poll(TURN + 2.0)
    pool.poll(TURN + 2.0)
    assert stuck.alive
    assert stuck.started[-1] is not machines[0].packed
    busy = next(process for process in processes if process.taken)
    busy.finish(report)
    assert [machine for machine, _ in pool.poll(TURN + 3.0)] == [machines[2]]


def test_a_kernel_that_compiles_slowly_has_more_time_with_each_turn(tasks: list[Task]) -> None:
    """So that also a slow computer compiles it in the end; here with one worker."""
    slow, other = (machine_of(state_for(name)) for name in (HOSTILE, NEW))
    pool, (slow, other), (worker,) = hall_of([slow, other], 1)
    times = list[float]()
    for _ in range(6):
        pool._known.clear()
        pool._failures[other.kernels] = 100  # so that the worker begins with the slow one
        worker.alive = False
        pool.poll(0.0)
        hangs(worker)
        pool.poll(0.0)
        pool.submit(other, tasks[0], 0.0)
        now = 0.0
        while worker.alive:
            now += 1.0
            pool.poll(now)
        times.append(now)
    assert times[:3] == pytest.approx([TURN, 2.0 * TURN, 4.0 * TURN], abs=2.0)
    assert times[-1] > COMPILE_TIMEOUT
