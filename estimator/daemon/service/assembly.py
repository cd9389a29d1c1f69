"""Make a daemon from a configuration, which is checked as a whole before anything is opened."""

import argparse
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from estimator import config as configuration
from estimator.can_io.binding import BoundMessage, bind, load_database
from estimator.can_io.database_limits import require_files
from estimator.can_io.foreign_senders import CVW
from estimator.can_io.publisher import output_groups
from estimator.can_io.trouble_codes import TroubleMemory
from estimator.checkpoint.store import StateStore
from estimator.config import Config, state_key
from estimator.daemon.outputs import configured
from estimator.daemon.outputs.output import Output
from estimator.daemon.reception.buses import BusSpec, NotThereError, open_bus, spec_of, with_bus
from estimator.daemon.reception.filters import input_filters, node_filters, of_group
from estimator.daemon.reception.link import Link
from estimator.daemon.reception.message_clock import MessageClock
from estimator.daemon.service import faults, file_permissions, folder_lock, folders
from estimator.daemon.service.boot_id import boot_id
from estimator.daemon.service.folder_lock import FolderLock, LockedStore
from estimator.daemon.service.loop import Daemon
from estimator.daemon.service.sd_notify import Notifier
from estimator.daemon.service.worker import BOOT, Worker
from estimator.daemon.transmitter import Transmitter
from estimator.errors import ConfigError, RoadloadError
from estimator.streaming.pipeline import Pipeline

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Everything that a daemon needs, checked: settings, bound messages, buses, and whose state may be restored."""

    config: Config
    messages: list[BoundMessage]
    source: BusSpec
    target: BusSpec | None
    key: str


def settle(path: Path | None, dbc: list[str] | None, options: argparse.Namespace) -> Config:
    """The configuration file, with what the command line puts in its place.

    Raises
    ------
    ConfigError
        The file is wrong, or every user may write it.
    """
    path = None if path is None else configuration.located(path)
    settings = configuration.load(path)
    if dbc:
        settings = configuration.replace(settings, bus=msgspec.structs.replace(settings.bus, dbc=dbc))
    transmit = with_bus(settings.transmit, options, "output_")
    if getattr(options, "transmit", False):
        transmit = msgspec.structs.replace(transmit, enabled=True)
    settings = configuration.replace(settings, reception=with_bus(settings.reception, options), transmit=transmit)
    with configuration.in_file(None if dbc else path):
        require_files(settings.bus.dbc)
    file_permissions.check_files(path, settings)
    return settings


def plan(path: Path | None, dbc: list[str] | None, options: argparse.Namespace) -> Plan:
    """Check everything that can be checked before a bus is opened.

    Raises
    ------
    InputError
        Configuration, databases, effects, the map or the choice of buses are wrong.
    """
    settings = settle(path, dbc, options)
    if settings.lake is not None:
        raise ConfigError("lake: a bus carries frames; take the table out")
    configured.check(settings)
    database = load_database(settings.bus.dbc)
    with configuration.in_file(path):
        messages = bind(settings, database)
        Pipeline(settings, is_live=True)  # raises if an effect is not known, or the map cannot be read
    for remark in database.remarks:
        log.warning("%s", remark)
    source = spec_of(options, settings.reception)
    source.resolved()
    target: BusSpec | None = None
    if settings.transmit.enabled:
        _check_groups(messages, settings)
        named = spec_of(options, settings.transmit, "output_")
        if (named.options or named.context is not None) and named.resolved() != source.resolved():
            target = named
    elif any(name.startswith("output_") for name in vars(options)):
        raise ConfigError("an output bus is named, but transmission is off; give --transmit or leave the bus out")
    return Plan(config=settings, messages=messages, source=source, target=target, key=state_key(settings))


def _check_groups(messages: list[BoundMessage], settings: Config) -> None:
    ours = output_groups(settings.publish.cvw)
    for message in messages:
        if message.by_pgn and message.key in ours:
            raise ConfigError(
                f"{message.name}: PGN {message.key:05X} is an input here and is broadcast by roadload too; "
                "bind another message, or switch transmission off"
            )


def restored(settings: Config, store: StateStore, key: str) -> Pipeline:
    """A pipeline that goes on where the last one stopped, as far as that is known."""
    state, reason = store.load(key)
    if reason:
        log.warning("saved state: %s", reason)
    elif state is None:
        log.info("%s", "no state saved yet")
    if state is not None:
        pipeline, boot = Pipeline(settings, is_live=True), boot_id()
        try:
            pipeline.restore(state, same_clock=bool(boot) and state.get(BOOT) == boot)
        except RoadloadError as error:
            log.warning("saved state discarded: %s", error)
        else:
            return pipeline
    return Pipeline(settings, is_live=True)


def rehearse(following: Plan, running: Plan) -> None:
    """Try what a plan needs beyond the one that is running, and leave it as it was.

    Raises
    ------
    RoadloadError
        A bus cannot be opened, or a folder cannot be used.
    """
    service = following.config.service
    states = folders.state_directory(service)
    if states != folders.state_directory(running.config.service):
        with folder_lock.alone(states):
            pass
    folders.make(folders.runtime_directory(service), 0o755)
    for spec in (following.source, following.target):
        if spec is None or spec in (running.source, running.target):
            continue
        try:
            open_bus(spec, None).shutdown()
        except NotThereError as error:
            raise NotThereError(f"{spec.label}: {error}") from error


def assemble(
    plan: Plan,
    lock: FolderLock,
    pipeline: Pipeline | None = None,
    notifier: Notifier | None = None,
    clocks: Mapping[str, MessageClock] | None = None,
) -> Daemon:
    """A daemon, not yet started; ``lock`` is that of its state folder.

    ``pipeline`` is one that goes on, instead of the saved state, with the `Daemon.clocks` of the one before.

    Raises
    ------
    ConfigError
        A folder cannot be made or used.
    """
    settings = plan.config
    reception, service = settings.reception, settings.service
    state_folder = folders.make(folders.state_directory(service), 0o700)
    store, codes = StateStore(state_folder), state_folder / faults.FILE
    runtime = folders.make(folders.runtime_directory(service), 0o755)
    filters, own = input_filters(plan.messages), node_filters(settings.publish.source_address)
    heard = [] if not settings.transmit.enabled else own if plan.target is None else [of_group(CVW)]
    source = Link(plan.source, [*filters, *heard] if reception.filter else None, reception)
    target = None if plan.target is None else Link(plan.target, own if reception.filter else None, reception)
    transmitter = None
    if settings.transmit.enabled:
        output = target or source
        transmitter = Transmitter(settings.publish, settings.transmit, output.send, np.random.default_rng())
        _recall_codes(transmitter, codes)
    worker = Worker(
        pipeline or restored(settings, store, plan.key),
        reception.queue_frames,
        LockedStore(store, lock),
        plan.key,
        service.save_interval_s,
    )

    def save_codes(memory: TroubleMemory) -> None:
        lock.require()
        faults.save(codes, memory)

    return Daemon(
        source,
        target,
        worker,
        transmitter,
        reception.silence_s,
        runtime / folders.STATUS_FILE,
        Path(service.metrics) if service.metrics else None,
        notifier,
        own_faults=faults.Faults(plan.messages, settings.publish.stale_after_s),
        save_codes=save_codes,
        clocks=clocks,
        outputs={
            name: Output(channel, period, np.random.default_rng())
            for name, (channel, period) in configured.channels(settings).items()
        },
        stale_after=settings.publish.stale_after_s,
    )


def listening(plan: Plan) -> Daemon:
    """A daemon, not yet started, that only listens: it sends nothing, and keeps neither state nor status."""
    reception = plan.config.reception
    source = Link(plan.source, input_filters(plan.messages) if reception.filter else None, reception)
    worker = Worker(Pipeline(plan.config), reception.queue_frames)
    return Daemon(source, None, worker, None, reception.silence_s)


def _recall_codes(transmitter: Transmitter, path: Path) -> None:
    """Take the trouble codes of an earlier run as previously active."""
    if transmitter.diagnostics is None:
        return
    try:
        transmitter.diagnostics.memory.remember(faults.load(path))
    except RoadloadError as error:
        log.warning("trouble codes of the last run are lost: %s", error)
