"""The rig as a whole: status, devices, methods, log, emergency stop."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from protocol.cli.link import Json, Keys, Rig, RunId, connect
from protocol.cli.output import (
    on_terminal,
    print_done,
    print_facts,
    print_json,
    print_table,
    say,
    seconds,
    size,
    when,
)
from protocol.cli.watch import count
from protocol.cli.words import frames, method
from protocol.errors import Code, UmbraError
from protocol.following import SILENCE_S
from protocol.messages.events import Logged
from protocol.messages.findings import Search
from protocol.messages.replies import Devices, Discovered, Log, Status
from protocol.messages.rig import DeviceInfo
from protocol.messages.runs import RunState

if TYPE_CHECKING:
    from protocol.client import Client

_CATCH_UP = 500  # records that are told from those that were shown


def status(rig: Rig = None, keys: Keys = None, as_json: Json = False) -> None:
    """What the rig is doing now: devices, the run under way, the queue, the lock, the disk.

    --json: a Status (docs/protocol.md).
    """
    with connect(rig, keys) as client:
        now = client.status()
        server = client.welcome.server
    if as_json:
        print_json(now)
        return
    print_facts(_status_lines(now, server))


def _status_lines(now: Status, server: str) -> list[tuple[str, str]]:
    lines = [
        ("rig", f"{now.rig} (umbrad {server}, up {seconds(now.uptime_s)})"),
        ("state", now.state.value),
    ]
    for device in now.devices:
        model = " · ".join(part for part in (device.model or device.driver, device.message) if part)
        homed = ", not homed" if device.facts.get("homed") is False else ""
        lines.append((device.name, f"{device.health.value}{homed} · {model}"))
    if now.run is not None:
        told = f"{now.run.state.value} · {now.run.id}: {method(now.run)}, {frames(now.run)}"
        if now.progress is not None and now.progress.rate_hz:
            told += f", {now.progress.rate_hz:.1f} Hz"
            if now.progress.remaining_s is not None:
                told += f", {seconds(now.progress.remaining_s)} left"
        lines.append(("run", told))
        waits = now.progress.waits if now.progress is not None else None
        if waits is not None:
            since = f"since {when(waits.since)}, until {when(waits.until)}"
            lines.append(("waits for", f"{waits.what}: {waits.seen} ({since})"))
        elif now.progress is not None and now.run.state is RunState.PAUSED:
            lines.append(("why", now.progress.phase))
    if (beside := now.reprocessing) is not None:
        told = f"{beside.run}: {count(beside)}" + (f", {beside.phase}" if beside.phase else "")
        lines.append(("reprocessing", told))
    lines.append(("queue", f"{len(now.queue)} waiting" if now.queue else "empty"))
    if now.lock is not None:
        note = f" ({now.lock.note})" if now.lock.note else ""
        left = f", {seconds(now.lock.remaining_s)} unless renewed"
        lines.append(("lock", f"held by {now.lock.owner}{note}{left}"))
    lines.append(
        ("disk", f"{size(now.free_bytes)} free, {size(now.reserve_bytes)} kept in reserve")
    )
    return lines


def devices(
    *,
    drivers: Annotated[
        list[str] | None, typer.Argument(metavar="[DRIVER]...", help="With --scan: only these.")
    ] = None,
    scan: Annotated[
        bool, typer.Option("--scan", help="What is attached, with the TOML to paste.")
    ] = False,
    timeout_s: Annotated[
        float, typer.Option("--timeout", min=0.1, max=120, help="With --scan: for each driver.")
    ] = 15.0,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """The devices: health, model, and what their drivers say of them.

    --scan looks for attached devices on the rig's machine, in the rig or not. Vendors' libraries
    look for cameras by broadcasts on every network of that machine: name the drivers to ask
    (umbra devices --scan grbl) where that is not welcome.

    --json: a Devices; with --scan a Discovered.
    """
    if scan:
        with connect(rig, keys) as client:
            searches = client.discover(*(drivers or ()), timeout_s=timeout_s)
        if as_json:
            print_json(Discovered(searches=searches))
        else:
            _print_searches(searches)
        return
    if drivers:
        raise UmbraError(Code.BAD_REQUEST, "drivers are named with --scan only", "--scan")
    with connect(rig, keys) as client:
        found = client.devices()
    if as_json:
        print_json(Devices(devices=found))
        return
    print_table(
        ["device", "health", "driver", "model", "serial", "facts"],
        [
            [d.name, d.health.value, d.driver, d.model, d.serial, d.message or _device_facts(d)]
            for d in found
        ],
    )


def _print_searches(searches: Sequence[Search]) -> None:
    """What was found as TOML with comments, to paste; who could not look as remarks."""
    for search in searches:
        for device in search.found:
            serial = f", serial {device.serial}" if device.serial else ""
            use = f" (in use: {device.used_by})" if device.used_by else ""
            print(f"# {device.model}{serial}{use}\n{device.toml}")
    nothing = [s.driver for s in searches if not s.found and not s.problem]
    if nothing:
        say(f"nothing attached: {', '.join(nothing)}")
    for search in searches:
        if search.problem:
            say(f"{search.kind} {search.driver}: {search.problem}")


def _device_facts(device: DeviceInfo) -> str:
    """What is true without its value, what is false, empty or unknown not at all."""
    told = {k: v for k, v in device.facts.items() if v not in (None, "", False)}
    return ", ".join(k if v is True else f"{k} {_short(v)}" for k, v in told.items())


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list | tuple):
        return "/".join(map(_short, value))
    return str(value)


def methods(rig: Rig = None, keys: Keys = None, as_json: Json = False) -> None:
    """The scan methods that the daemon knows, one a line.

    --json: the Welcome that a daemon greets with.
    """
    with connect(rig, keys) as client:
        welcome = client.welcome
    if as_json:
        print_json(welcome)
        return
    for name in welcome.methods:
        print(name)


def log(
    *,
    run: RunId = "",
    limit: Annotated[
        int, typer.Option("-n", "--limit", min=1, max=10_000, help="How many records.")
    ] = 50,
    daemon: Annotated[bool, typer.Option("--daemon", help="The daemon's own log.")] = False,
    follow: Annotated[
        bool, typer.Option("-f", "--follow", help="And those that come, until Ctrl-C.")
    ] = False,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """The last log records of a run, the oldest first; without RUN or with --daemon, the daemon's.

    A run's are kept in its folder (log.jsonl, up to 1 MiB). Of its own the daemon keeps the last
    5000 since its start; its journal (journalctl -u umbrad) has them all.

    --json: a Log; with --follow a record a line.
    """
    of = "" if daemon else run
    with connect(rig, keys) as client:
        if follow:
            with contextlib.suppress(KeyboardInterrupt):
                for record in _followed(client, of, limit):
                    if as_json:
                        print_json(record, lines=True)
                    else:
                        print(log_line(record), flush=True)
            return
        records = client.log(of, limit)
    if as_json:
        print_json(Log(records=records))
        return
    for record in records:
        print(log_line(record))
    if not records:
        say("no records since umbrad's start; its journal goes further: journalctl -u umbrad")


def _followed(client: Client, run: str, limit: int) -> Iterator[dict[str, Any]]:
    """The last records, then those that come. Subscribed to before it is asked, so that none is
    between; what both have is left out. After a gap or a long silence what was missed is asked for.
    """
    with client.subscribe(Logged.topic) as events:
        shown = list(client.log(run, limit))
        yield from shown
        while True:
            notice = events.next(SILENCE_S)
            new: Sequence[dict[str, Any]]
            if notice is not None and not notice.gap and isinstance(notice.body, Logged):
                new = [notice.body.record]
            else:
                new = client.log(run, _CATCH_UP)
            for one in new:
                if one not in shown and (not run or one.get("run") == run):
                    shown = [*shown[-_CATCH_UP:], one]
                    yield one


def log_line(record: dict[str, Any]) -> str:
    """A log record as one line: time, level, what happened, the rest as key=value; a traceback,
    where there is one, below it."""
    rest = {name: value for name, value in record.items() if value not in ("", None)}
    time = str(rest.pop("timestamp", ""))
    level = str(rest.pop("level", "")).upper()
    event = str(rest.pop("event", ""))
    trace = str(rest.pop("exception", ""))
    if on_terminal() and len(time) > 19:
        time = time[11:23]
    values = " ".join(f"{name}={value}" for name, value in rest.items())
    line = "  ".join(part for part in (time, f"{level:7}", event, values) if part.strip())
    return "\n    ".join([line, *trace.splitlines()])


def stop(rig: Rig = None, keys: Keys = None, as_json: Json = False) -> None:
    """Emergency stop: dark, held, run aborted, everything refused until `umbra reset`.

    --json: a Done.
    """
    with connect(rig, keys) as client:
        client.estop()
    print_done("stopped", "stopped; `umbra reset` ends the emergency stop", as_json=as_json)


def reset(rig: Rig = None, keys: Keys = None, as_json: Json = False) -> None:
    """End an emergency stop: devices are checked, then the queue goes on.

    --json: a Done.
    """
    with connect(rig, keys) as client:
        client.reset()
    print_done("reset", "reset; the queue goes on", as_json=as_json)
