"""Channels of a log: choice of those that are read, and check that several can be read as one bus."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.frames import EXTENDED, Frames
from estimator.errors import LogError
from estimator.signals import Mask

Numbers = NDArray[np.unsignedinteger[Any]]

UNNAMED = ""  # where a log does not say the channel
MAX_CHANNELS = 250  # of a log; loggers have some dozens
MAX_NAMED = 20  # channels that a message names
MAX_IDENTS = 1 << 16  # that are remembered; a bus has far fewer


class Channels:
    """Counts the frames of a log by channel, and keeps those of some channels.

    Without a choice all channels are read as one bus, unless an identifier comes on two of them. It would belong to
    different senders, or to one sender that is recorded twice.

    Attributes
    ----------
    counts : collections.Counter[str]
        Frames by channel, as the log names it, read or not.
    shared : tuple[int, str, str] or None
        First identifier that comes on two channels, and these channels; None if there is none, or some are chosen.
    """

    def __init__(self, wanted: Iterable[str] = ()) -> None:
        self._wanted = frozenset(wanted)
        self.clear()

    def clear(self) -> None:
        """Reset the counts for a new pass over the log."""
        self.counts: Counter[str] = Counter()
        self.shared: tuple[int, str, str] | None = None
        self._channel_of: dict[int, str] = {}  # by identifier
        self._last: tuple[NDArray[np.uint32], str] | None = None  # identifiers of the only channel so far, and its name

    def keep(self, frames: Frames, channel: Numbers, name: Callable[[int], str] = str) -> Frames:
        """Select the frames of read channels; ``name`` gives the name of each of the channels (n,)."""
        return frames[self.rows(frames.ident, channel, name)]

    def rows(self, ident: NDArray[np.uint32], channel: Numbers, name: Callable[[int], str] = str) -> slice | Mask:
        """Mask (n,) or slice of the frames that are read, by identifiers (n,) and channels (n,)."""
        if not len(ident):
            return slice(0)
        first = channel[0]
        if (channel == first).all():  # the rule
            return slice(None) if self._take(ident, name(int(first))) else slice(0)
        wanted = np.zeros(len(ident), np.bool_)
        for number in np.unique(channel)[: MAX_CHANNELS + 1].tolist():  # so many are refused by `check_number`
            part = channel == number
            if self._take(ident[part], name(number)):
                wanted |= part
        return slice(None) if wanted.all() else wanted

    def _take(self, ident: NDArray[np.uint32], name: str) -> bool:
        """Count frames of a channel; returns True if they are read."""
        self.counts[name] += len(ident)
        if self._wanted:
            return name in self._wanted
        if len(self.counts) == 1:
            self._last = ident, name  # the newest are enough: what a bus sends, it sends again
            return True
        if self._last is not None:
            self._note(*self._last)
            self._last = None
        self._note(ident, name)
        return True

    def _note(self, ident: NDArray[np.uint32], name: str) -> None:
        """Note the identifiers of a channel, up to the first that comes on two channels."""
        if self.shared is not None:
            return
        for identifier in np.unique(ident).tolist():
            if (other := self._channel_of.get(identifier, name)) != name:
                self.shared = identifier, other, name
                break
            if len(self._channel_of) < MAX_IDENTS:
                self._channel_of[identifier] = name

    def check_number(self, path: Path) -> None:
        """Check that the number of channels is plausible.

        Raises
        ------
        LogError
            There are more than MAX_CHANNELS.
        """
        if len(self.counts) > MAX_CHANNELS:
            raise LogError(f"{path}: more than {MAX_CHANNELS} channels; give the log that the logger wrote")

    def check(self, path: Path) -> None:
        """Check that the channels of a log that was read can be used.

        Raises
        ------
        LogError
            An identifier comes on two channels and none was chosen, or no chosen one is in the log.
        """
        there = described(self.counts)
        if self.shared is not None:
            ident, *names = self.shared
            shown = f"{ident & ~EXTENDED:0{8 if ident & EXTENDED else 3}X}"
            both = " and ".join(name or "without a name" for name in names)
            raise LogError(f"{path}: channels {both} both send {shown}; choose with --channel: it has {there}")
        if self._wanted and not self._wanted & self.counts.keys():
            wanted = ", ".join(sorted(self._wanted))
            raise LogError(f"{path}: no frame of channel {wanted}; choose another --channel: it has {there}")


def described(counts: Mapping[str, int]) -> str:
    """Describe channels and their numbers of frames in words."""
    parts = [f"{name or 'without a name'} ({count:,} frames)" for name, count in sorted(counts.items())]
    more = f" and {len(parts) - MAX_NAMED} more" if len(parts) > MAX_NAMED else ""
    return f"channel{'s' * (len(parts) > 1)} {', '.join(parts[:MAX_NAMED])}{more}" if parts else "no data frame"
