"""Where recordings go."""

from pathlib import Path

from otolith.paths import state_directory
from otolith.plan import Plan


def recording_folder(plan: Plan) -> Path:
    """Where the machine file says, else in the state directory."""
    return (plan.recording_folder or state_directory() / "recordings").absolute()
