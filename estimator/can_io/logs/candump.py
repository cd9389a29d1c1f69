"""Logs of SocketCAN's candump, in the form of ``candump -l`` or copied from its screen output."""

from estimator.can_io.logs.candump_line import layout
from estimator.can_io.logs.line_layout import Layout
from estimator.can_io.logs.line_log import LineLog


class CandumpLog(LineLog):
    """Log in candump's ``.log`` format."""

    def _layout(self, line: bytes) -> Layout | None:
        return layout(line)
