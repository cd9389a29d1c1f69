"""Reading of recorded CAN traffic: ``open_log(path)`` yields batches of frames from any known format."""

from estimator.can_io.logs.log import Log
from estimator.can_io.logs.opening import FORMATS, open_log

__all__ = ["FORMATS", "Log", "open_log"]
