"""Bayesian road-load estimation from CAN traffic: vehicle mass, rolling resistance and drag.

The names in ``__all__`` are public; all other modules may change. They are imported when they are first used, so that
the command line starts fast and a daemon does not load what it does not need.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from estimator.config import load as load_config
    from estimator.fleet.library import estimate_drives
    from estimator.library.diagnosis import diagnose
    from estimator.library.estimation import estimate
    from estimator.library.reading import from_table, read, read_drives
    from estimator.model.effects import Effect
    from estimator.residual.diagnose import diagnose_residual
    from estimator.residual.inputs import Axis, Candidate
    from estimator.streaming.drive_extraction import diagnose_logs
    from estimator.streaming.listener import Listener
    from estimator.streaming.replay import estimate_logs

__version__ = "0.2.0"
__all__ = [
    "Axis",
    "Candidate",
    "Effect",
    "Listener",
    "diagnose",
    "diagnose_logs",
    "diagnose_residual",
    "estimate",
    "estimate_drives",
    "estimate_logs",
    "from_table",
    "load_config",
    "read",
    "read_drives",
]

_HOMES = {  # module and name there
    "Axis": ("estimator.residual.inputs", "Axis"),
    "Candidate": ("estimator.residual.inputs", "Candidate"),
    "Effect": ("estimator.model.effects", "Effect"),
    "Listener": ("estimator.streaming.listener", "Listener"),
    "diagnose": ("estimator.library.diagnosis", "diagnose"),
    "diagnose_logs": ("estimator.streaming.drive_extraction", "diagnose_logs"),
    "diagnose_residual": ("estimator.residual.diagnose", "diagnose_residual"),
    "estimate": ("estimator.library.estimation", "estimate"),
    "estimate_drives": ("estimator.fleet.library", "estimate_drives"),
    "estimate_logs": ("estimator.streaming.replay", "estimate_logs"),
    "from_table": ("estimator.library.reading", "from_table"),
    "load_config": ("estimator.config", "load"),
    "read": ("estimator.library.reading", "read"),
    "read_drives": ("estimator.library.reading", "read_drives"),
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _HOMES[name]
    return getattr(import_module(module), attribute)
