"""Reading recorded CAN traffic: ``open_log(path)`` yields batches of frames from any of the known formats."""

from estimator.can_io.logs.log import Log
from estimator.can_io.logs.opening import FORMATS, open_log
from estimator.can_io.logs.time_order import MAX_STEP_BACK, TimeOrder

__all__ = ["FORMATS", "MAX_STEP_BACK", "Log", "TimeOrder", "open_log"]
