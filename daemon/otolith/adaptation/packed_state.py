"""A state as bytes, for those that only pass it on.

A worker unpacks a state and packs the next one. The daemon passes it to the next worker, saves it and keeps it as
evidence: it looks into a state far more seldom than it gets one. The plan, which is the largest part of a state and
stays the same, is packed apart from the rest, so that states share its bytes.
"""

import pickle
from dataclasses import dataclass, replace
from functools import lru_cache

from otolith.adaptation.state import AdaptationState
from otolith.health.diagnosis import MonitoringPlan

PLANS = 256  # that a process keeps unpacked; machines with the same limits and rules share one
_NO_PLAN = MonitoringPlan()


@dataclass(frozen=True, slots=True, eq=False)
class PackedState:
    """A state, and what the daemon must know of each one."""

    rest: bytes  # The state without its plan
    plan: bytes
    records: int  # Of the next window
    is_valid: bool
    keys: tuple[str, ...]
    """What is saved at once when it changes: components, open events with their states, notes of persons."""

    @classmethod
    def of(cls, state: AdaptationState, before: "PackedState | None" = None) -> "PackedState":
        """Pack a state, with the bytes of the plan of the state ``before`` if it is the same one."""
        plan = before.plan if before is not None and state.plan is _plan_of(before.plan) else pickle.dumps(state.plan)
        rest = pickle.dumps(replace(state, plan=_NO_PLAN))
        return cls(rest, plan, state.records, state.is_valid, keys_of(state))

    def unpack(self) -> AdaptationState:
        """Return the state."""
        state: AdaptationState = pickle.loads(self.rest)  # noqa: S301 - of our own processes
        return replace(state, plan=self.unpack_plan())

    def unpack_plan(self) -> MonitoringPlan:
        """Return the plan of the state."""
        return _plan_of(self.plan)

    def without_plan(self) -> "PackedState":
        """Return it for one who knows the plan."""
        return replace(self, plan=b"")

    def with_plan_of(self, before: "PackedState") -> "PackedState":
        """Return it with the plan of the state ``before``, unless it has one."""
        return self if self.plan else replace(self, plan=before.plan)


def keys_of(state: AdaptationState) -> tuple[str, ...]:
    """Return the :attr:`PackedState.keys` of a state."""
    events = (f"{event.id} {event.state}" for event in state.health.open_events)
    return (*(known.component.key for known in state.adopted), *events, *state.health.taken, *state.health.shelves)


@lru_cache(PLANS)
def _plan_of(packed: bytes) -> MonitoringPlan:
    plan: MonitoringPlan = pickle.loads(packed)  # noqa: S301 - of our own processes
    return plan
