"""Beltgauge over Modbus TCP. Register map @version@; printed from the tables in src/plc: do not edit.

It needs Python 3.9 or later and pymodbus: pip install "pymodbus>=3.11,<4"

    python beltgauge.py HOST --csv FILE            takes every parcel from the queue and acknowledges it
    python beltgauge.py HOST --csv FILE --watch    reads only, beside a PLC that acknowledges

The first one needs `queue = true` under [plc], and this computer's address in modbus.write_allow. A parcel is
acknowledged when its line is on the disk. Numbers that go on after a restart need plc.state_file, which an installed
appliance has: by its number a parcel that comes once more is known.
"""

from __future__ import annotations

import argparse
import csv
import io
import os
import sys
import time
from collections import deque
from dataclasses import astuple, dataclass, fields
from datetime import datetime, timezone
from enum import IntEnum, IntFlag
from typing import IO, Any, Callable, Iterable, Iterator, TypeVar

from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException

@constants@

# A client that has nothing to read asks again after this time.
POLL_S = 0.05
# Between two attempts to connect.
RECONNECT_S = 0.5


Answer = TypeVar("Answer")


@codes@


class BeltgaugeError(Exception):
    """What does not go away by trying again."""


def _u32(block: list[int], at: int) -> int:
    """Two registers, the high word first."""
    return block[at] << 16 | block[at + 1]


def _signed(stored: int, bits: int) -> int:
    """Two's complement."""
    return stored - (1 << bits) if stored >> (bits - 1) else stored


@dataclass(frozen=True)
class Parcel:
    """One parcel."""

@parcel@

    @property
    def is_whole(self) -> bool:
        """There is a parcel, and it did not change between two requests."""
        return self.sequence != 0 and self.sequence == self.sequence_end

    @property
    def may_be_used(self) -> bool:
        """Sort by the dimensions only when this is true."""
        return self.is_whole and Valid.MAY_BE_USED in self.valid

    @property
    def is_box(self) -> bool:
        """A box; otherwise the dimensions are of the smallest upright box that holds it."""
        return Valid.IS_BOX in self.valid

    def x_now_mm(self, now: Status) -> float:
        """Where its centre is along travel."""
        travelled = round(now.belt_travel_mm * @travel_scale@) - round(self.belt_travel_mm * @travel_scale@)
        return self.x_mm + _signed(travelled % (1 << 32), 32) / @travel_scale@


@dataclass(frozen=True)
class Status:
    """The appliance's state and counters."""

@status@


class Beltgauge:
    """A connection that is made anew when it is lost.

    Every method raises ConnectionError when the appliance does not answer: try again. BeltgaugeError says what
    must be put right first.
    """

    def __init__(self, host: str, port: int = 502, timeout_s: float = 5.0) -> None:
        self._name = f"{host}:{port}"
        self._beats = 0
        self._client = ModbusTcpClient(host, port=port, timeout=timeout_s, retries=0)

    def __enter__(self) -> Beltgauge:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def status(self) -> Status:
        """State and counters."""
        return Status.decode(self._read(0, STATUS_REGISTERS))

    def latest(self) -> Parcel | None:
        """The parcel that left the zone last."""
        return self._parcel(LATEST)

    def recent(self, sequence: int) -> Parcel | None:
        """A parcel by its number, from 1, if it is among the last @ring_parcels@."""
        parcel = self._parcel(RING + (sequence - 1) % RING_PARCELS * PARCEL_REGISTERS)
        return parcel if parcel and parcel.sequence == sequence else None

    def waiting(self) -> Parcel | None:
        """The oldest parcel that was not acknowledged."""
        return self._parcel(QUEUE)

    def heartbeat(self) -> None:
        """This client is alive: plc.heartbeat_timeout_s may watch it."""
        self._beats = (self._beats + 1) & 0xFFFF
        self._write(PLC_HEARTBEAT, [self._beats])

    def acknowledge(self, parcel: Parcel) -> None:
        """The parcel was taken: the next one may come."""
        # Together with the heartbeat: a number from before a restart is then left out, not refused.
        self._write(PLC_HEARTBEAT, [self._beats, parcel.sequence & 0xFFFF])

    def take(self, taken: Iterable[int] = (), poll_s: float = POLL_S) -> Iterator[Parcel]:
        """Every parcel of the queue, once and in order, over restarts of either side.

        A parcel is acknowledged when the next one is asked for. `taken` has the numbers of the last @ring_parcels@ parcels
        that an earlier run took.
        """
        known = deque(taken, maxlen=RING_PARCELS)
        while True:
            self._patiently(self.heartbeat)
            parcel = self._patiently(self.waiting)
            if parcel is None:
                time.sleep(poll_s)
                continue
            if parcel.sequence not in known:
                yield parcel
                known.append(parcel.sequence)
            try:
                self.acknowledge(parcel)
            except ConnectionError:
                pass  # it comes once more, and is known

    def watch(self, last: int = 0, poll_s: float = POLL_S) -> Iterator[Parcel]:
        """Every parcel after number `last`, without a word to the appliance.

        Numbers that are left out are of parcels that were gone before they were read.
        """
        while True:
            newest = self._patiently(lambda: _u32(self._read(PARCELS, 2), 0))
            if newest < last:
                last = 0  # the appliance keeps no numbers: they began anew
            for sequence in range(max(last, newest - RING_PARCELS) + 1, newest + 1):
                parcel = self._patiently(lambda: self.recent(sequence))
                if parcel is not None:
                    yield parcel
                last = sequence
            time.sleep(poll_s)

    def command(self, command: Command, argument: int = 0, timeout_s: float = 10.0) -> int:
        """Carried out once, whatever restarts meanwhile. Returns its Result."""
        end_s = time.monotonic() + timeout_s
        ticket = self._patiently(lambda: self._read(TICKET_DONE, 1))[0] % 65535 + 1
        while time.monotonic() < end_s:
            try:
                self._write(TICKET, [ticket, command, argument >> 16, argument & 0xFFFF])
                done, result = self._read(TICKET_DONE, 2)
                if done == ticket:
                    return result
                time.sleep(POLL_S)
            except ConnectionError:
                time.sleep(RECONNECT_S)
        raise ConnectionError(f"{self._name} did not carry out command {int(command)} in {timeout_s} s")

    def _patiently(self, ask: Callable[[], Answer]) -> Answer:
        """The answer, when there is one at last."""
        told = False
        while True:
            try:
                return ask()
            except ConnectionError as error:
                if not told:
                    print(f"{error}; trying again", file=sys.stderr)
                told = True
                time.sleep(RECONNECT_S)

    def _parcel(self, address: int) -> Parcel | None:
        parcel = Parcel.decode(self._read(address, PARCEL_REGISTERS))
        return parcel if parcel.is_whole else None

    def _connect(self) -> None:
        if self._client.connected:
            return
        if not self._client.connect():
            raise ConnectionError(f"no connection to {self._name}")
        start = self._request(lambda: self._client.read_holding_registers(0, count=IDENTITY_REGISTERS))
        if start[IDENTITY] != @identity@:
            raise BeltgaugeError(f"{self._name} is no Beltgauge")
        if start[MAP_VERSION] >> 8 != MAP_MAJOR:
            raise BeltgaugeError(f"register map {start[MAP_VERSION] >> 8}, not {MAP_MAJOR}: take its own beltgauge.py")
        if _u32(start, TEST_U32) != @test_u32@:
            raise BeltgaugeError('set modbus.word_order = "high_first"')

    def _read(self, address: int, count: int) -> list[int]:
        self._connect()
        return self._request(lambda: self._client.read_holding_registers(address, count=count))

    def _write(self, address: int, values: list[int]) -> None:
        self._connect()
        self._request(lambda: self._client.write_registers(address, values))

    def _request(self, send: Callable[[], Any]) -> list[int]:
        try:
            answer = send()
        except (ModbusException, OSError) as error:
            self._client.close()
            raise ConnectionError(f"{self._name}: {error}") from error
        if not answer.isError():
            return list(answer.registers)
        if answer.exception_code == 1:
            raise BeltgaugeError(f"{self._name} lets this address not write: see modbus.write_allow")
        raise BeltgaugeError(f"{self._name} answers with exception {answer.exception_code}")


class CsvLog:
    """A file with one line a parcel, on the disk before the next one is asked for."""

    HEADER = ["utc"] + [field.name for field in fields(Parcel)]

    def __init__(self, path: str) -> None:
        self._file: IO[bytes] = open(path, "ab+")
        self.last = self._resume(path)
        if self._file.tell() == 0:
            self._append(self.HEADER)

    def _resume(self, path: str) -> list[int]:
        """Cut off a line that a power cut left unfinished; return the last numbers."""
        header = ",".join(self.HEADER).encode() + b"\n"
        self._file.seek(0)
        if not header.startswith(self._file.readline()):
            raise BeltgaugeError(f"{path} has other columns: name another file")
        size = self._file.seek(0, os.SEEK_END)
        self._file.seek(max(0, size - 64 * 1024))
        tail = self._file.read()
        whole = tail[: tail.rfind(b"\n") + 1]
        self._file.truncate(size - len(tail) + len(whole))
        self._file.seek(0, os.SEEK_END)
        lines = whole.removeprefix(header).splitlines()
        return [int(line.split(b",")[1]) for line in lines[-RING_PARCELS:]]

    def write(self, parcel: Parcel) -> None:
        """Add a parcel."""
        utc = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        self._append([utc, *(int(v) if isinstance(v, int) else v for v in astuple(parcel))])

    def _append(self, cells: list[object] | list[str]) -> None:
        line = io.StringIO()
        csv.writer(line, lineterminator="\n").writerow(cells)
        self._file.write(line.getvalue().encode())
        self._file.flush()
        os.fsync(self._file.fileno())


def main() -> None:
    """Log parcels until it is stopped."""
    parser = argparse.ArgumentParser(description="Log the parcels that a Beltgauge measures.")
    parser.add_argument("host", help="address of the appliance")
    parser.add_argument("--port", type=int, default=502, help="502; the demo has 1502")
    parser.add_argument("--csv", required=True, metavar="FILE", help="is continued if it is there")
    parser.add_argument("--watch", action="store_true", help="only read, do not acknowledge")
    arguments = parser.parse_args()
    try:
        log = CsvLog(arguments.csv)
        with Beltgauge(arguments.host, arguments.port) as gauge:
            last = log.last[-1] if log.last else 0
            for parcel in gauge.watch(last) if arguments.watch else gauge.take(log.last):
                log.write(parcel)
    except (BeltgaugeError, OSError) as error:
        sys.exit(f"beltgauge.py: {error}")
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
