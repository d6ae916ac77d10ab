"""Beltgauge over Modbus TCP. Register map 2.0; printed from the tables in src/plc: do not edit.

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

MAP_MAJOR = 2  # of the register map
LATEST = 100  # address of the latest parcel
QUEUE = 140  # of the oldest parcel that waits to be acknowledged
RING = 200  # of the last parcels
RING_PARCELS = 32  # how many they are
PARCEL_REGISTERS = 32  # registers of one parcel
STATUS_REGISTERS = 83  # of the status block, from address 0
IDENTITY = 0  # addresses of values
MAP_VERSION = 1
TEST_U32 = 2
IDENTITY_REGISTERS = 5  # from address 0, with all of these
PARCELS = 19
TICKET_DONE = 40  # the result is in the next register
PLC_HEARTBEAT = 60  # acknowledge is in the next register
TICKET = 64  # command and argument are in the next registers

# A client that has nothing to read asks again after this time.
POLL_S = 0.05
# Between two attempts to connect.
RECONNECT_S = 0.5


Answer = TypeVar("Answer")


class StatusBit(IntFlag):
    """Bits of the status word."""

    RUNNING = 1
    READY = 2
    BELT_MEASURED = 4
    BY_ENCODER = 8
    STOPPED = 16
    PLC_SILENT = 32
    PARCELS_WAIT = 64


class Fault(IntFlag):
    """Bits of the fault word."""

    SOURCE_ENDED = 1
    TABLE_FULL = 2
    PARCEL_NEVER_ACKNOWLEDGED = 4
    CAN_OFF = 8
    ENCODER_SILENT = 16
    CAMERA_ABSENT = 32
    DISK_FAILS = 64
    ENCODER_DISAGREES = 128
    BELT_NOT_AS_CONFIGURED = 256
    BELT_HIDES_PARCELS = 512
    FRAMES_MISSING = 1024
    ARCHIVE_FAILS = 2048
    CAMERA_MOVED = 4096
    PICTURE_BLURRED = 8192
    LIGHT_CHANGED = 16384


class Valid(IntFlag):
    """Bits of a parcel's `valid`."""

    MAY_BE_USED = 1
    IS_BOX = 2
    BY_ENCODER = 4
    MEASURED = 8


class Flag(IntFlag):
    """Doubts about a parcel."""

    UNFINISHED = 1  # still inside when the input ended
    MERGED = 2  # its image ran together with a neighbour's for some of the pass
    CLIPPED = 4  # it reached over the side of the zone; parts outside are not used
    HEIGHT_UNCERTAIN = 8  # standard deviation of the height above measure.sigma_max_mm
    SPEED_ASSUMED = 16  # belt speed assumed, not measured: trust no height
    LOST = 32  # it vanished inside the zone, or over a gap in the frames
    SILHOUETTE_ONLY = 64  # too few edges: a rough size, trust no dimension
    TOO_TALL = 128  # taller than view.height_max_mm: trust no dimension
    FOOTPRINT_UNCERTAIN = 256  # standard deviation of length or width above measure.sigma_max_mm
    HEIGHT_DISPUTED = 512  # texture on the top and its edges disagree about the height


class NotMeasured(IntEnum):
    """Why a parcel has no dimensions; 0: it has."""

    TOO_BRIEF = 1  # seen in too few frames or over too little travel
    NEVER_ALONE = 2  # its image was never apart from another's
    LOST = 3  # it vanished inside the zone before its edges could be measured
    BELT_MOTION_UNKNOWN = 4  # the belt's motion was not known while it passed, as over a gap in the frames


class Reason(IntEnum):
    """What matters most in the appliance's state."""

    ALL_IS_WELL = 0  # all is well
    SOURCE_ENDED = 1  # the frame source has ended or failed
    NO_FRAMES = 2  # no frames arrive
    CAN_BUS_OFF = 3  # CAN: bus off
    CAN_DOWN = 4  # CAN: interface down or not there
    CAN_ERROR_PASSIVE = 5  # CAN: error passive, nobody acknowledges
    ENCODER_SILENT = 6  # the encoder does not count
    PLC_SILENT = 7  # the PLC is silent
    LEARNING = 8  # the empty belt is being learned
    STOPPED = 9  # stopped by command
    PARCEL_NEVER_ACKNOWLEDGED = 10  # a parcel found the queue full and was never acknowledged, since start
    TABLE_FULL = 11  # a table or queue has been full since start, see the counters
    CAMERA_ABSENT = 12  # the camera is not there, or does not do what the configuration asks for: see the log
    IMPORT_REFUSED = 13  # the last configuration that was imported was refused: see its report
    DISK_FAILS = 14  # the disk fails: sequence numbers, acknowledgments and tickets would not survive a restart; see the log
    ENCODER_DISAGREES = 15  # the encoder and the belt disagree: see encoder_ratio; correct encoder.mm_per_count, or give command 6
    BELT_NOT_AS_CONFIGURED = 16  # the belt does not run as configured: see belt_seen for its speed and direction
    BELT_AMBIGUOUS = 17  # the belt's texture repeats itself, so that its motion is ambiguous: fit an encoder
    BELT_HIDES_PARCELS = 18  # the belt's texture or the camera's noise is so strong that it hides parcels
    FRAMES_MISSING = 19  # of the frames of the last 10 s more than 1 in 100 are missing: see frames_dropped, frames_lost, frames_torn
    ARCHIVE_FAILS = 20  # the archive: its disk fails or does not answer, entries were lost, or damage was found, since start; see the page
    CAMERA_MOVED = 21  # the camera has moved a little: see camera_moved, camera_error; fasten it
    CAMERA_MISPLACED = 22  # the camera has moved so far that sizes and places are wrong: calibrate the belt again
    PICTURE_BLURRED = 23  # the picture is less sharp than it should be: see blur; clean and focus the lens
    PICTURE_UNUSABLE = 24  # the picture is so unsharp that heights are wrong: see blur; focus the lens
    LIGHT_CHANGED = 25  # the light has changed, or the lens is dirty: see light_region, light_change


class Command(IntEnum):
    """What may be commanded."""

    ACKNOWLEDGE = 1  # acknowledge parcels up to sequence number `argument`, as register `acknowledge` does
    LEARN = 2  # learn the empty belt anew: takes background.learn_frames, parcels in view are forgotten
    START = 3  # start: report parcels
    STOP = 4  # stop: report none until started
    ROUND = 5  # round dimensions to multiples of `argument` tenths of a mm, 1 to 500
    CORRECT_ENCODER = 6  # correct the encoder's scale by the belt's texture: mm_per_count becomes mm_per_count_seen, for good; refused when they differ by more than 40 %


class Result(IntEnum):
    """What became of a command."""

    NONE = 0  # no command yet
    DONE = 1  # done
    UNKNOWN_COMMAND = 2  # no such command
    ARGUMENT_OUT_OF_RANGE = 3  # argument out of range: nothing was changed
    BUSY = 4  # busy with earlier commands: try again with the next ticket
    TICKET_USED = 5  # the last command, another one, had this ticket: nothing was done, take the next ticket
    NOT_KNOWN = 6  # what it needs is not known: no encoder, or the belt has not travelled far enough


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

    sequence: int  # from 1; 0 = no parcel yet
    valid: Valid  # bit 0 the dimensions may be used: sort by them only then; bit 1 its shape is a box; bit 2 the encoder told the belt's motion; bit 3 it was measured
    flags: Flag  # doubts
    length_mm: float  # longer side of the footprint, or as plc.order says
    width_mm: float  # shorter side of the footprint, or as plc.order says
    height_mm: float  # height over the belt, or as plc.order says
    yaw_deg: float  # length axis against travel, counter-clockwise, (-90, 90]
    x_mm: float  # footprint centre along travel, at time
    y_mm: float  # footprint centre across, left positive
    sigma_length_mm: float  # standard deviation
    sigma_width_mm: float  # standard deviation
    sigma_height_mm: float  # standard deviation
    quality_length_percent: int  # 100 - 20 sigma/mm, at least 0
    quality_width_percent: int  # 100 - 20 sigma/mm, at least 0
    quality_height_percent: int  # 100 - 20 sigma/mm, at least 0
    belt_speed_mm_per_s: float  # mean over the pass
    frame: int  # frame at which x and y hold; wraps
    time_ms: int  # time of that frame since start; wraps
    belt_travel_mm: float  # belt travel since start at that frame; wraps after 429 km
    not_measured: int  # why it has no dimensions; 0: it has
    sequence_end: int  # equals sequence unless the block changed between two requests

    @classmethod
    def decode(cls, block: list[int]) -> Parcel:
        """From the registers of its block."""
        return cls(
            sequence=_u32(block, 0),
            valid=Valid(block[2]),
            flags=Flag(block[3]),
            length_mm=block[4] / 10,
            width_mm=block[5] / 10,
            height_mm=block[6] / 10,
            yaw_deg=_signed(block[7], 16) / 100,
            x_mm=_signed(_u32(block, 8), 32) / 10,
            y_mm=_signed(_u32(block, 10), 32) / 10,
            sigma_length_mm=block[12] / 100,
            sigma_width_mm=block[13] / 100,
            sigma_height_mm=block[14] / 100,
            quality_length_percent=block[15],
            quality_width_percent=block[16],
            quality_height_percent=block[17],
            belt_speed_mm_per_s=_u32(block, 18) / 10,
            frame=_u32(block, 20),
            time_ms=_u32(block, 22),
            belt_travel_mm=_u32(block, 24) / 10,
            not_measured=block[26],
            sequence_end=_u32(block, 30),
        )

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
        travelled = round(now.belt_travel_mm * 10) - round(self.belt_travel_mm * 10)
        return self.x_mm + _signed(travelled % (1 << 32), 32) / 10


@dataclass(frozen=True)
class Status:
    """The appliance's state and counters."""

    identity: int  # constant 0x4247, "BG"
    map_version: int  # major in the high byte, minor in the low
    test_u32: int  # constant 0x12345678: checks the word order
    test_i16: int  # constant -12345: checks the sign
    heartbeat: int  # rises ten times a second while frames arrive; wraps
    status: StatusBit  # bit 0 running, bit 1 ready (belt learned), bit 2 belt motion measured, bit 3 by the encoder, bit 4 stopped by command, bit 5 PLC silent, bit 6 parcels wait to be acknowledged
    fault: Fault  # bit 0 frame source ended, bit 1 a table has been full since start (see counters), bit 2 a parcel was never acknowledged, bit 3 CAN bus off or down, bit 4 encoder silent, bit 5 no camera, bit 6 the disk fails, bit 7 encoder and belt disagree, bit 8 the belt does not run as configured, bit 9 the belt hides parcels, bit 10 frames are missing, bit 11 the archive fails, bit 12 the camera has moved, bit 13 the picture is unsharp, bit 14 the light has changed
    belt_speed_mm_per_s: float  # belt speed
    frames: int  # frames processed; wraps
    frames_dropped: int  # frames that came too late; wraps
    parcels: int  # sequence number of the latest parcel
    parcels_unmeasured: int  # of the parcels, those that could not be measured
    parcels_lost: int  # parcels that vanished inside the view
    segment_overflows: int  # frames with more runs or blobs than the tables hold
    track_overflows: int  # blobs that found no free track
    event_overflows: int  # records that found the queue to the PLC full
    time_ms: int  # time of the newest frame since start; wraps
    belt_travel_mm: float  # belt travel since start; wraps after 429 km
    reason: int  # what matters most
    boots: int  # starts of the appliance, 0 when plc.state_file is not set; wraps
    queued: int  # parcels that wait to be acknowledged
    queue_overflows: int  # parcels that left the queue without having been acknowledged; wraps
    ticket_done: int  # ticket of the last command
    result: int  # what became of it
    scale_interval_mm: float  # dimensions are rounded to multiples of it
    can_state: int  # 0 not configured, 1 active, 2 error passive, 3 bus off, 4 down
    can_transmit_errors: int  # error counter of the controller, when it last told
    can_receive_errors: int  # error counter of the controller, when it last told
    can_bus_offs: int  # how often the bus was lost; wraps
    can_parcels_dropped: int  # parcels that could not be sent in time; wraps
    can_frames_refused: int  # frames that the interface refused for ever; wraps
    frames_lost: int  # frames that the camera counted and that never came; wraps
    frames_torn: int  # frames that came with parts missing; wraps
    camera_losses: int  # how often the camera was lost; wraps
    imports: int  # configurations that came on a stick; wraps
    import_result: int  # of the last: 0 there was none, 1 applied, 2 refused, 3 rolled back
    belt_seen_mm_per_s: float  # belt speed that the pictures show, negative against +X; 0: none
    encoder_ratio: float  # the encoder's travel over the belt's, negative when it counts the other way; 0: not known, or it stands
    mm_per_count: float  # belt travel of a count, as configured or set by command 6; 0: no encoder
    mm_per_count_seen: float  # the same as the belt's texture shows it; 0: not known
    camera_watch: int  # whether a camera that moves is seen: 0 what stands is being learned, 1 no: too little stands, 2 across travel alone, 3 along travel alone, 4 yes
    camera_moved_px: float  # how far the picture has moved since start
    camera_error_mm: float  # the largest error that it causes, of a place or of a dimension
    blur_px: float  # standard deviation of the picture's blur; 0: not known
    light_region: int  # the part of the picture whose light has changed most since start: 4 columns and 3 rows, from 1 at the top left, row by row; 0: not known
    light_change_percent: int  # by how much

    @classmethod
    def decode(cls, block: list[int]) -> Status:
        """From the registers of its block."""
        return cls(
            identity=block[0],
            map_version=block[1],
            test_u32=_u32(block, 2),
            test_i16=_signed(block[4], 16),
            heartbeat=block[10],
            status=StatusBit(block[11]),
            fault=Fault(block[12]),
            belt_speed_mm_per_s=_u32(block, 13) / 10,
            frames=_u32(block, 15),
            frames_dropped=_u32(block, 17),
            parcels=_u32(block, 19),
            parcels_unmeasured=_u32(block, 21),
            parcels_lost=_u32(block, 23),
            segment_overflows=_u32(block, 25),
            track_overflows=_u32(block, 27),
            event_overflows=_u32(block, 29),
            time_ms=_u32(block, 31),
            belt_travel_mm=_u32(block, 33) / 10,
            reason=block[35],
            boots=block[36],
            queued=block[37],
            queue_overflows=_u32(block, 38),
            ticket_done=block[40],
            result=block[41],
            scale_interval_mm=block[42] / 10,
            can_state=block[43],
            can_transmit_errors=block[44],
            can_receive_errors=block[45],
            can_bus_offs=_u32(block, 46),
            can_parcels_dropped=_u32(block, 48),
            can_frames_refused=_u32(block, 50),
            frames_lost=_u32(block, 52),
            frames_torn=_u32(block, 54),
            camera_losses=block[56],
            imports=block[57],
            import_result=block[58],
            belt_seen_mm_per_s=_signed(_u32(block, 70), 32) / 10,
            encoder_ratio=_signed(block[72], 16) / 10000,
            mm_per_count=_signed(_u32(block, 73), 32) / 1000000,
            mm_per_count_seen=_signed(_u32(block, 75), 32) / 1000000,
            camera_watch=block[77],
            camera_moved_px=block[78] / 100,
            camera_error_mm=block[79] / 100,
            blur_px=block[80] / 100,
            light_region=block[81],
            light_change_percent=_signed(block[82], 16),
        )


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
        """A parcel by its number, from 1, if it is among the last 32."""
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

        A parcel is acknowledged when the next one is asked for. `taken` has the numbers of the last 32 parcels
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
        if start[IDENTITY] != 0x4247:
            raise BeltgaugeError(f"{self._name} is no Beltgauge")
        if start[MAP_VERSION] >> 8 != MAP_MAJOR:
            raise BeltgaugeError(f"register map {start[MAP_VERSION] >> 8}, not {MAP_MAJOR}: take its own beltgauge.py")
        if _u32(start, TEST_U32) != 0x12345678:
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
