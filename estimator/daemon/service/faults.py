"""Which faults there are, as trouble codes: of the inputs, of the estimate, and of this device.

An input has the SPN of its signal (attribute "SPN" of the database); one without has a number of our own, by its role.
Numbers of our own are from the range that J1939-73 leaves to manufacturers.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from estimator.can_io.binding import BoundMessage
from estimator.can_io.contradiction import Contradiction
from estimator.can_io.source_selection import KIND, Kind
from estimator.can_io.trouble_codes import MAX_CODES, MAX_COUNT, MAX_SPN, Fmi, TroubleCode, TroubleMemory
from estimator.daemon.service.worker import Knowledge
from estimator.errors import InputError, StateError
from estimator.estimates import Status
from estimator.input_files import MIB, read_own
from estimator.output_files import write
from estimator.signals import Role

FILE = "trouble_codes.json"
MAX_FILE_BYTES = MIB  # bytes; codes have some kB
ESTIMATE, FRAMES_LOST, STATE_NOT_SAVED = 516096, 516097, 516098  # SPNs
FIRST_ROLE = 516352  # SPN of the first role of `Role`, where its signal has none
MAX_SILENCE_S = 30.0  # s of traffic without an input of the road load, after which it counts as not coming
LOSS_HOLD_S = 60.0  # s for which a loss of frames counts as present
FMI_OF = {Contradiction.ALTERNATING: Fmi.ERRATIC, Contradiction.FASTER: Fmi.UPDATE_RATE}  # others: network data


class Faults:
    """Finds the faults of a daemon in what it knows.

    Parameters
    ----------
    messages
        What is bound to roles.
    stale_after
        Age [s] from which an estimate is broadcast as stale.
    """

    def __init__(self, messages: Iterable[BoundMessage], stale_after: float) -> None:
        bound = [(f"{m.name}.{s.signal.name}", s) for m in messages for s in m.signals]
        self._spn = {path: s.signal.spn or FIRST_ROLE + list(Role).index(s.role) for path, s in bound}
        self._of_role = {s.role: self._spn[path] for path, s in bound}
        self._stale_after = stale_after
        self._lost = 0
        self._lost_at = -float("inf")

    def present(self, knowledge: Knowledge, now: float, lost: int, state_problem: str) -> set[TroubleCode]:
        """Faults at monotonic time ``now`` [s].

        Parameters
        ----------
        lost
            Frames dropped since the start, by kernel or queues.
        state_problem
            Why the state could not be saved; empty if it could.
        """
        found = self._of_inputs(knowledge)
        estimate, t = knowledge.estimate, knowledge.t
        if estimate is not None and t is not None and t - estimate.t > self._stale_after:
            found.add(TroubleCode(ESTIMATE, Fmi.UPDATE_RATE))
        elif estimate is not None and estimate.status is Status.INVALID:
            found.add(TroubleCode(ESTIMATE, Fmi.ERRATIC))
        if lost > self._lost:
            self._lost, self._lost_at = lost, now
        if now - self._lost_at < LOSS_HOLD_S:
            found.add(TroubleCode(FRAMES_LOST, Fmi.NETWORK_DATA))
        if state_problem:
            found.add(TroubleCode(STATE_NOT_SAVED, Fmi.BAD_DEVICE))
        return found

    def _of_inputs(self, knowledge: Knowledge) -> set[TroubleCode]:
        found = {
            TroubleCode(self._spn[path], FMI_OF.get(Contradiction(reason), Fmi.NETWORK_DATA))
            for path, reason in knowledge.contested.items()
        }
        silent = [*map(self._number, knowledge.missing), *self._silent(knowledge)]
        return found | {TroubleCode(spn, Fmi.UPDATE_RATE) for spn in silent}

    def _silent(self, knowledge: Knowledge) -> list[int]:
        """SPNs of inputs of the road load that came once and stay away while others come.

        Where none comes, the ignition is off, and others keep the bus awake.
        """
        t = -float("inf") if knowledge.t is None else knowledge.t
        ages = {
            spn: t - knowledge.newest[role.value]
            for role, spn in self._of_role.items()
            if KIND.get(role) is Kind.MEASURED and role.value in knowledge.newest
        }
        if all(age > MAX_SILENCE_S for age in ages.values()):
            return []
        return [spn for spn, age in ages.items() if age > MAX_SILENCE_S]

    def _number(self, name: str) -> int:
        """SPN of an input that never came: MESSAGE.signal, or its role where none is bound."""
        return self._spn.get(name) or FIRST_ROLE + list(Role).index(Role(name))


class _Kept(msgspec.Struct, frozen=True):
    spn: Annotated[int, Meta(ge=0, le=MAX_SPN)]
    fmi: Annotated[int, Meta(ge=0, le=31)]
    count: Annotated[int, Meta(ge=0, le=MAX_COUNT)]


def save(path: Path, memory: TroubleMemory) -> None:
    """Write all codes to a file.

    Raises
    ------
    RoadloadError
        It cannot be written.
    """
    codes = [_Kept(code.spn, code.fmi, count) for code, count in (memory.previous | memory.active).items()]
    write(path, msgspec.json.encode(codes), 0o600)


def load(path: Path) -> list[tuple[TroubleCode, int]]:
    """Codes of an earlier run, none where there is no file.

    Raises
    ------
    InputError
        The file cannot be read, or is not one of codes.
    """
    try:
        kept = msgspec.json.decode(read_own(path, MAX_FILE_BYTES), type=list[_Kept])
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except StateError as error:
        raise InputError(f"{path}: {error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError):
        raise InputError(f"{path}: holds no trouble codes") from None
    return [(TroubleCode(one.spn, one.fmi), one.count) for one in kept[: 2 * MAX_CODES]]
